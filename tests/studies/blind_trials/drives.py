"""What is driven in blind trials: motion that excites every effect, hardly any, or one command a run."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.records import Array
from terrain.robots import BicycleRobot, Robot
from terrain.simulation.scenario import Conditions

DURATION_S = 60.0  #: Length of a run
STEP_HZ = 50.0  #: Rate of the commanded twists

COMMAND_S, LEAD_S, HOLD_S = 6.0, 2.0, 0.3
"""Length of a run that is one command, of the drive before its log begins, and for how long the command
before holds in it."""

COMMAND_MPS2 = 2.0
"""The most by which the wheels of a side speed up in such a run, so that a command is reached in its lead."""

CAR_MPS2, CAR_SIDE_MPS2, CAR_CURVATURE_PMS = 1.5, 2.5, 1.0
"""The most by which a car-like robot speeds up and accelerates to the side, and by which its curvature
changes in a second."""

COMMAND_GRADE_RATIO = 0.01
"""Standard deviation of the slope under such runs, which have no measured tilt: a yard."""


class Drives(NamedTuple):
    """Drives of a trial: twists and hills of each run, and for how long is driven before the log begins."""

    twists: tuple[Array, ...]
    hills: tuple[Conditions, ...]
    lead_s: float = 0.0


def rich_drives(rng: np.random.Generator, n_runs: int, duration_s: float = DURATION_S) -> Drives:
    """Return drives that excite all effects: steps of speed and turn, stops, reversals, spot turns, hills."""
    return Drives(tuple(_mixed_drive(rng, duration_s) for _ in range(n_runs)), rich_hills(rng, n_runs))


def rich_hills(rng: np.random.Generator, n_runs: int) -> tuple[Conditions, ...]:
    """Return slopes of all directions that undulate, one a run."""
    return tuple(
        Conditions(
            grade_ratio=(rng.normal(0.0, 0.04), rng.normal(0.0, 0.04)),
            undulation_ratio=abs(rng.normal(0.0, 0.03)),
        )
        for _ in range(n_runs)
    )


def poor_drives(rng: np.random.Generator, n_runs: int, duration_s: float = DURATION_S) -> Drives:
    """Return drives that excite hardly any effect: one speed, level terrain, little steering."""
    n = round(duration_s * STEP_HZ) + 1
    time_s = np.arange(n) / STEP_HZ
    twists = []
    for _ in range(n_runs):
        twist = np.zeros((n, 3))
        twist[:, 0] = np.clip(0.5 * (time_s - 0.5), 0.0, rng.uniform(0.65, 0.75))
        phase = rng.uniform(0.0, 2 * math.pi)
        twist[:, 2] = 0.01 * np.sin(2 * math.pi * time_s / 20.0 + phase) * (time_s > 5.0)
        twists.append(twist)
    return Drives(tuple(twists), tuple(Conditions() for _ in range(n_runs)))


def car_drives(
    rng: np.random.Generator, robot: BicycleRobot, n_runs: int, duration_s: float = DURATION_S
) -> Drives:
    """Return drives of a car-like robot that excite all its effects: steps of speed and curvature, hills.

    It drives up to half its fastest speed, backward up to a quarter of that, and turns as tightly as
    :data:`CAR_SIDE_MPS2` lets it.
    """
    fastest_mps = 0.5 * robot.speed_max_mps
    tightest_radpm = 0.9 * math.tan(robot.steering_max_rad) / robot.wheelbase_m
    n = round(duration_s * STEP_HZ) + 1
    twists = []
    for _ in range(n_runs):
        desired = np.zeros((n, 2))
        k = round(1.5 * STEP_HZ)
        while k < n - round(5.0 * STEP_HZ):
            length = round(rng.uniform(2.0, 5.0) * STEP_HZ)
            kind = rng.choice(["ahead", "turn", "back", "stop"], p=[0.25, 0.5, 0.15, 0.1])
            ahead = fastest_mps * (-0.25 * rng.uniform(0.4, 1.0) if kind == "back" else rng.uniform(0.2, 1.0))
            speed = 0.0 if kind == "stop" else ahead
            most = min(tightest_radpm, CAR_SIDE_MPS2 / max(speed**2, 1e-9))
            turn = 0.0 if kind == "ahead" else rng.uniform(-most, most)
            desired[k : k + length] = speed, turn
            k += length
        desired[n - round(5.0 * STEP_HZ) :] = 0.0
        (speed,) = _limit_rate(desired[:, :1], CAR_MPS2).T
        (turn,) = _limit_rate(desired[:, 1:], CAR_CURVATURE_PMS).T
        twists.append(np.column_stack([speed, np.zeros(n), speed * turn]))
    return Drives(tuple(twists), rich_hills(rng, n_runs))


def command_drives(rng: np.random.Generator, robot: Robot, n_runs: int) -> Drives:
    """Return drives of one command a run, as DRIVE has them: the wheel speeds of each side are drawn.

    A run begins at the command before, which its lead reaches from rest.
    """
    n = round((LEAD_S + COMMAND_S) * STEP_HZ) + 1
    fastest_mps = robot.motors.speed_max_radps * robot.wheel_radius_m
    twists = []
    for _ in range(n_runs):
        desired = np.zeros((n, 2))
        for first in (1, round((LEAD_S + HOLD_S) * STEP_HZ)):
            desired[first:] = rng.uniform(-fastest_mps, fastest_mps, 2)
        left, right = _limit_rate(desired, COMMAND_MPS2).T
        twists.append(np.column_stack([(left + right) / 2, np.zeros(n), (right - left) / robot.track_m]))
    hills = tuple(
        Conditions(grade_ratio=tuple(rng.normal(0.0, COMMAND_GRADE_RATIO, 2).tolist())) for _ in range(n_runs)
    )
    return Drives(tuple(twists), hills, LEAD_S)


def _mixed_drive(rng: np.random.Generator, duration_s: float) -> Array:
    n = round(duration_s * STEP_HZ) + 1
    desired = np.zeros((n, 3))
    k = round(1.5 * STEP_HZ)
    while k < n - round(3.0 * STEP_HZ):
        length = round(rng.uniform(2.0, 5.0) * STEP_HZ)
        kind = rng.choice(["ahead", "stop", "back", "spot", "turn"], p=[0.4, 0.1, 0.15, 0.1, 0.25])
        speed, turn = rng.uniform(0.3, 1.0), 0.0
        if kind == "stop":
            speed = 0.0
        elif kind == "back":
            speed, turn = -rng.uniform(0.3, 0.8), rng.uniform(-0.4, 0.4) * rng.integers(2)
        elif kind == "spot":
            speed, turn = 0.0, rng.choice([-1.0, 1.0]) * rng.uniform(0.3, 0.8)
        elif kind == "turn":
            turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.1, 0.6)
        desired[k : k + length] = speed, 0.0, turn
        k += length
    desired[n - round(3.0 * STEP_HZ) :] = 0.0
    return _limit_rate(desired)


def _limit_rate(desired: Array, most: float = 1.0) -> Array:
    """Return columns (n, k) from rest that change by at most so much in a second: m/s^2, rad/s^2."""
    limit = most / STEP_HZ
    limited = np.zeros_like(desired)
    for axis, goals in enumerate(desired.T.tolist()):  # numbers of Python's own: arrays of three are slow
        value, values = 0.0, [0.0]
        for goal in goals[1:]:
            change = goal - value
            value += limit if change > limit else -limit if change < -limit else change
            values.append(value)
        limited[:, axis] = values
    return limited
