"""Wheels and steering against their commands: what does not follow, and what only lags or is noisy."""

import math

import numpy as np
import pytest

from terrain.control.robot_control import Actuation
from terrain.records import Reading

PERIOD_S = 0.02
MPS_PER_RADPS = 0.02


def accelerating(time_s):
    """A start at 1 m/s^2 to 1 m/s, steady motion, and a stop at once at 4 s."""
    return 0.0 if time_s > 4.0 else min(max(time_s, 0.0), 1.0)


def steering(time_s):
    """Turned by 0.3 rad within a second, held, and turned back from 4 s on."""
    return 0.3 * min(time_s, 1.0) if time_s < 4.0 else max(0.3 - 0.5 * (time_s - 4.0), 0.0)


def drive(wheels=None, steers=None, duration_s=6.0, lag_s=0.0, seed=0):
    """Return the times, and (n, 6) what was off its command, of a robot whose motors lag by a low-pass.

    ``wheels(time_s, mps)`` and ``steers(time_s, rad)`` change what is measured, (3,) each.
    """
    rng, actuation = np.random.default_rng(seed), Actuation(MPS_PER_RADPS)
    mps, off, times_s = np.zeros(3), [], []
    for k in range(round(duration_s / PERIOD_S)):
        time_s = k * PERIOD_S
        command = np.full(3, accelerating(time_s))
        mps += (command - mps) * (1.0 if lag_s == 0.0 else -math.expm1(-PERIOD_S / lag_s))
        measured = mps + 0.004 * rng.standard_normal(3)
        angles = np.full(3, steering(time_s)) + 0.001 * rng.standard_normal(3)
        measured = measured if wheels is None else wheels(time_s, measured)
        angles = angles if steers is None else steers(time_s, angles)
        reading = None
        if measured is not None:
            values = np.concatenate([measured / MPS_PER_RADPS, np.ones(3)])[None]
            reading = Reading(np.array([time_s]), values)
        actuation.measured(time_s, PERIOD_S, reading, angles)
        actuation.commanded(command, np.full(3, steering(time_s)))
        off.append(actuation.off.copy())
        times_s.append(time_s)
    return np.array(times_s), np.array(off)


def one(change, place=1, until_s=math.inf):
    """Change one of three values from a time on."""

    def changed(time_s, values):
        if 2.0 <= time_s < until_s:
            values[place] = change(time_s, values[place])
        return values

    return changed


@pytest.mark.parametrize("lag_s", [0.0, 0.05, 0.1])
def test_wheels_that_follow_with_a_lag_are_never_off(lag_s):
    _, off = drive(lag_s=lag_s)
    assert not off.any()


DEVIATIONS = {
    "stands": lambda time_s, value: 0.0,
    "reads a fifth more": lambda time_s, value: 1.2 * value,
    "reads a fifth less": lambda time_s, value: 0.8 * value,
    "reads backwards": lambda time_s, value: -value,
    "reads something else": lambda time_s, value: 3.0,
}


@pytest.mark.parametrize(("place", "deviation"), [*enumerate(DEVIATIONS)])
def test_a_wheel_that_does_not_follow_is_off_within_a_quarter_of_a_second_and_alone(deviation, place):
    place %= 3
    time_s, off = drive(wheels=one(DEVIATIONS[deviation], place, until_s=3.0))
    assert not off[:, [i for i in range(6) if i != place]].any()
    assert not off[time_s < 2.0].any()
    assert off[(time_s >= 2.25) & (time_s < 3.0), place].all()
    assert not off[time_s > 3.4].any()


def test_a_motor_whose_command_changes_and_whose_rate_does_not_is_off():
    """Frozen at 1 m/s; the command to stop is what shows it."""
    time_s, off = drive(wheels=one(lambda time_s, value: 1.0))
    assert off[time_s > 4.8, 1].all()
    assert not off[:, [0, 2]].any()


@pytest.mark.parametrize(
    ("place", "error_rad", "is_off"), [(0, 0.1, True), (2, -0.1, True), (1, 0.03, False)]
)
def test_a_steering_angle_that_does_not_follow_is_off(place, error_rad, is_off):
    time_s, off = drive(steers=one(lambda time_s, value: value + error_rad, place, until_s=3.0))
    assert not off[:, [i for i in range(6) if i != 3 + place]].any()
    if is_off:
        assert off[(time_s >= 2.25) & (time_s < 3.0), 3 + place].all()
    else:
        assert not off.any()
    assert not off[time_s > 3.5].any()


def test_steering_that_stands_while_its_command_turns_is_off():
    held = []
    time_s, off = drive(steers=one(lambda time_s, value: held.append(value) or held[0], 2))
    assert off[time_s > 4.7, 5].all()
    assert not off[time_s < 4.0].any()
    assert not off[:, :5].any()


@pytest.mark.parametrize("value", [1e3, -1e3, 1.5, math.nan])
def test_single_spikes_and_gaps_are_not_off(value):
    def spiky(time_s, values):
        if round(time_s / PERIOD_S) % 25 == 7:
            values[0] = value
        return values

    _, off = drive(wheels=spiky)
    assert not off.any()


@pytest.mark.parametrize("silence", [lambda t, v: None, lambda t, v: np.full(3, math.nan)])
def test_what_is_not_measured_is_not_off_and_what_was_off_before_is_over(silence):
    def change(time_s, values):
        if 2.0 <= time_s < 3.0:
            values[0] = 0.0
        return silence(time_s, values) if time_s >= 3.0 else values

    time_s, off = drive(wheels=change)
    assert off[(time_s > 2.3) & (time_s < 3.0), 0].all()
    assert not off[time_s > 3.3].any()
