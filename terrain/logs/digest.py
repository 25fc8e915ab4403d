"""A digest that names the content of runs, wherever and however they lie."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

import numpy as np

from terrain.records import Array, RunLog


def data_digest(runs: Sequence[RunLog]) -> str:
    """Return a SHA-256 over the content of the runs, in hexadecimal.

    It covers ids, robots, sessions, labels, channels, times and values, and neither order nor source nor
    layout on disk: a data set read from CSV and from the run folders it was imported into has one digest.
    """
    digest = hashlib.sha256()
    for run in sorted(runs, key=lambda run: run.run_id):
        orders = {name: np.argsort(stream.channels) for name, stream in sorted(run.streams.items())}
        head = {
            "run_id": run.run_id,
            "robot": run.robot,
            "labels": [list(label) for label in run.labels],
            **({"session": run.session} if run.session else {}),
            "streams": {
                name: [len(run.streams[name]), [run.streams[name].channels[i] for i in order]]
                for name, order in orders.items()
            },
        }
        digest.update(json.dumps(head, sort_keys=True).encode())
        for name, order in orders.items():
            digest.update(_canonical_bytes(run.streams[name].time_s))
            digest.update(_canonical_bytes(run.streams[name].values[:, order]))
    return digest.hexdigest()


def joint_digest(digests: Sequence[str]) -> str:
    """Return a SHA-256 over the digests of runs, whatever their order."""
    return hashlib.sha256("".join(f"{digest}\n" for digest in sorted(digests)).encode()).hexdigest()


def _canonical_bytes(array: Array) -> bytes:
    """Return little-endian doubles with one form of NaN and one of zero."""
    return (np.where(np.isnan(array), np.nan, array) + 0.0).astype("<f8").tobytes()
