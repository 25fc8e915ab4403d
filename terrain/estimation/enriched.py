"""A run log with its estimate beside what was measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrain.estimation.estimate import Estimate
from terrain.estimation.stuck import Motion
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.schema import ESTIMATOR_CHANNELS
from terrain.records import RunLog, Stream


def enriched(estimate: Estimate) -> RunLog:
    """Return the run with its estimate.

    Wheel speeds join the stream ``wheels``.  New are ``slip``; ``estimator``, the states that windows are
    made of; and ``state``, of which no features are made: every state and ``std_<state>``,
    ``std_slip_<wheel>_ratio``, ``stale_ratio`` (1 where the speed over ground was not measured lately),
    ``stuck_ratio`` (1 where the robot is stuck, NaN where that is unknown) and ``nis_<sensor>_ratio``.
    """
    run = with_wheel_speeds(estimate.run, estimate.robot)
    track = estimate.track
    channels = tuple(state for state in ESTIMATOR_CHANNELS if state in track.states)
    values = np.column_stack([track.state(state) for state in channels])
    streams = dict(run.streams)
    streams["estimator"] = Stream(track.time_s, values, channels)
    streams["slip"] = estimate.slip.as_stream()
    streams["state"] = _state_stream(estimate)
    return replace(run, streams=streams, filter=estimate.name)


def _state_stream(estimate: Estimate) -> Stream:
    """Return all outputs of the filter; a column without any finite value is left out."""
    track, slip = estimate.track, estimate.slip
    columns = {state: track.state(state) for state in track.states}
    columns |= {f"std_{state}": track.std(state) for state in track.states}
    columns |= {f"std_slip_{wheel}_ratio": slip.slip_std[:, i] for i, wheel in enumerate(slip.wheels)}
    columns["stale_ratio"] = slip.stale.astype(float)
    if (motion := estimate.motion) is not None:
        columns["stuck_ratio"] = np.where(motion == Motion.UNKNOWN, np.nan, motion == Motion.STUCK)
    columns |= {f"nis_{sensor}_ratio": track.nis[:, k] for k, sensor in enumerate(track.sensors)}
    known = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    return Stream(track.time_s, np.column_stack(list(known.values())), tuple(known))
