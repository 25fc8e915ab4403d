"""A pilot in a drive that its exceptions do not end, with a record of what it does."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipelines.live.pilot import LivePilot
from terrain.control.traction import TractionStatus
from terrain.records import Command, Sample

FRESH = "fresh"
"""Status of a sensor that nothing is wrong with, in a pilot's ``health``."""

NAMED_S = 0.1
"""A sensor counts as named where it has been for this time."""


class GuardedPilot:
    """Passes samples to a pilot; where it fails, the wheels keep their last command.

    Parameters
    ----------
    pilot : gets the samples.  Its ``health``, a mapping from a sensor to the name of its status or a method
        that returns one, is recorded where it has one

    Attributes
    ----------
    n_exceptions, n_not_finite : steps at which it raised, or gave a command that is not three finite numbers
    exception : the first one, or empty
    speed_mps : estimated forward speed after each step; NaN where there is none
    health : after each step; None where the pilot has none
    """

    def __init__(self, pilot: LivePilot) -> None:
        self._pilot = pilot
        self._last: Command | None = None
        self.n_exceptions = self.n_not_finite = 0
        self.exception = ""
        self.speed_mps: list[float] = []
        self.health: list[dict[str, str] | None] = []

    def step(self, sample: Sample) -> Command:
        """Return the pilot's command, or its last one that was finite with the status ``NO_SLIP``.

        Raises
        ------
        Exception
            that of the pilot, if it is in the first step.
        """
        try:
            command = self._pilot.step(sample)
        except Exception as error:
            if self._last is None:
                raise
            self.n_exceptions += 1
            self.exception = self.exception or f"{type(error).__name__}: {error}"
            command = _without_correction(self._last)
        else:
            if is_finite(command) or self._last is None:
                self._last = command
            else:
                self.n_not_finite += 1
                command = _without_correction(self._last)
        estimate = self._pilot.estimate
        self.speed_mps.append(math.nan if estimate is None else estimate.speed_x_mps)
        self.health.append(_health(self._pilot))
        return command


def is_finite(command: Command) -> bool:
    """Return whether all that is commanded is three finite numbers."""
    try:
        rows = [np.asarray(row, dtype=np.float64) for row in command[:3]]
    except (TypeError, ValueError):
        return False
    return all(row.shape == (3,) and bool(np.isfinite(row).all()) for row in rows)


def named_sensors(
    health: list[dict[str, str] | None], acts: list[bool], step_s: float
) -> dict[str, str] | None:
    """Return the sensors that were named as other than fresh, with how, for :data:`NAMED_S` at least.

    Parameters
    ----------
    health : after each step
    acts : whether the fault acted at it
    step_s : from step to step

    Examples
    --------
    >>> named_sensors([{"imu": "fresh"}, {"imu": "lost"}, {"imu": "lost"}], [True] * 3, step_s=0.05)
    {'imu': 'lost'}
    """
    named = [each for each, acting in zip(health, acts, strict=True) if acting]
    if not named or all(each is None for each in named):
        return None
    counts = Counter((sensor, status) for each in named if each for sensor, status in each.items())
    found: dict[str, str] = {}
    for (sensor, status), n in counts.items():
        if status != FRESH and n * step_s >= NAMED_S - 1e-9:
            found[sensor] = f"{found[sensor]}, {status}" if sensor in found else status
    return found


def _health(pilot: Any) -> dict[str, str] | None:
    health = getattr(pilot, "health", None)
    health = health() if callable(health) else health
    if not isinstance(health, Mapping):
        return None
    return {str(sensor): str(getattr(status, "name", status)).lower() for sensor, status in health.items()}


def _without_correction(command: Command) -> Command:
    changed = {"status_code": float(TractionStatus.NO_SLIP), "slip_ratio": math.nan}
    return command._replace(status={**command.status, **changed})
