"""What a robot's control aims for on slick terrain and on a slope, and which of its sensors and motors it names."""

import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.control.robot_control import (
    DECELERATION_RATIO,
    DEFAULT_SETTINGS,
    SLICK_RATIO,
    Actuation,
    RobotControl,
    braking_by_slip,
    uphill_mps2,
)
from terrain.control.slip_table import load_slip_table
from terrain.estimation.health import Health
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.records import Reading
from terrain.robots import load_robot
from terrain.slip_learning.curve import traction_ratio

ROBOT = load_robot("agrimaro")


@pytest.fixture(scope="module")
def standing():
    """The estimate of a robot that stands, and the states of its filter."""
    estimator = make_live_filter("vio15", ROBOT, CHANNELS)
    estimator.step({"wheels": Reading(np.array([0.0]), np.zeros((1, 6)))})
    return estimator.latest, estimator.states


@pytest.mark.parametrize("speed_mps", [0.5, -0.5])
@pytest.mark.parametrize(("axis", "tilt_rad"), [("speed_x_mps", (0.0, -0.1)), ("speed_y_mps", (0.1, 0.0))])
def test_gravity_decelerates_uphill_in_any_direction(standing, axis, tilt_rad, speed_mps):
    seen = standing[0]._replace(**{"speed_x_mps": 0.0, "speed_y_mps": 0.0, axis: speed_mps})
    found = uphill_mps2(seen, *tilt_rad)
    assert found == pytest.approx(math.copysign(9.81 * math.sin(0.1), speed_mps), rel=0.01)
    assert uphill_mps2(standing[0]._replace(speed_x_mps=0.0, speed_y_mps=0.0), *tilt_rad) == 0.0


@pytest.mark.parametrize(
    ("statuses", "named", "health"),
    [
        ({}, None, Health.FRESH),
        ({"gyro": Health.LATE}, None, Health.LATE),
        ({"wheel_1": Health.LOST, "camera_speed": Health.FROZEN}, "camera_speed", Health.FROZEN),
        ({"wheel_1": Health.STEPPED, "camera_speed": Health.LOST}, "wheel_1", Health.STEPPED),
        ({"wheel_1": Health.GATED, "camera_speed": Health.LOST}, "camera_speed", Health.LOST),
    ],
)
def test_the_sensor_is_named_that_takes_others_with_it(standing, statuses, named, health):
    seen, states = standing
    control = RobotControl(ROBOT, load_slip_table(), DEFAULT_SETTINGS, states)
    judged = np.array([statuses.get(name, Health.FRESH) for name in control.sensors], dtype=np.int8)
    place, status = control._judge(seen._replace(health=judged))
    assert (control.sensors[place] if place >= 0 else None, status) == (named, health)


class Curve:
    """The law of a table's curve, with its resistance."""

    resistance_ratio = 0.02

    def __init__(self, law, *parameters):
        self.thrust_ratio = lambda slip: traction_ratio(law, parameters, slip)


def test_slick_terrain_with_falling_thrust_is_braked_at_its_peak():
    """D sin(C atan(B s)) without curvature has its peak D where C atan(B s) is a right angle."""
    b, c, d = 25.0, 1.5, 0.3
    slip_ratio, mps2 = braking_by_slip(Curve("magic", b, c, d, 0.0))
    assert slip_ratio == pytest.approx(np.tan(np.pi / 2 / c) / b, abs=0.002)
    assert mps2 == pytest.approx(DECELERATION_RATIO * (d + 0.02) * GRAVITY_MPS2, rel=1e-3)


def test_where_locked_wheels_stop_as_soon_there_is_no_braking_by_slip():
    assert braking_by_slip(Curve("janosi", 0.3, 0.05)) is None  # rises up to the locked wheel
    for c, d in ((1.0, 0.3), (1.5, SLICK_RATIO + 0.01), (1.2, 0.3)):  # rises, grips, hardly falls
        assert braking_by_slip(Curve("magic", 25.0, c, d, 0.0)) is None


# -- Wheels and steering against their commands: what does not follow, and what only lags or is noisy

PERIOD_S, MPS_PER_RADPS = 0.02, 0.02


def drive(change=lambda time_s, values: values, lag_s=0.0):
    """Return the times, and (n, 6) what was off its command, of a robot whose motors lag by a low-pass.

    A start at 1 m/s^2 to 1 m/s, steered by 0.3 rad, and a stop at once at 4 s while it is steered back.  What is
    measured of wheels and steering (6,) is changed by ``change(time_s, values)``; None is no sample of the wheels.
    """
    rng, actuation = np.random.default_rng(0), Actuation(MPS_PER_RADPS)
    mps, off, times_s = np.zeros(3), [], np.arange(300) * PERIOD_S
    for time_s in times_s:
        command = np.full(3, 0.0 if time_s > 4.0 else min(time_s, 1.0))
        steer = np.full(3, 0.3 * min(time_s, 1.0) if time_s < 4.0 else max(0.3 - 0.5 * (time_s - 4.0), 0.0))
        mps += (command - mps) * (1.0 if lag_s == 0.0 else -math.expm1(-PERIOD_S / lag_s))
        noise = np.repeat([0.004, 0.001], 3) * rng.standard_normal(6)
        measured, reading = change(time_s, np.concatenate([mps, steer]) + noise), None
        if measured is not None:
            values = np.concatenate([measured[:3] / MPS_PER_RADPS, np.ones(3)])[None]
            reading = Reading(np.array([time_s]), values)
        actuation.measured(time_s, PERIOD_S, reading, None if measured is None else measured[3:])
        actuation.commanded(command, steer)
        off.append(actuation.off.copy())
    return times_s, np.array(off)


def one(place, change, until_s=math.inf):
    """Change one of six values from 2 s on."""

    def changed(time_s, values):
        if 2.0 <= time_s < until_s:
            values[place] = change(values[place])
        return values

    return changed


def spiky(value):
    def changed(time_s, values):
        values[0] = value if round(time_s / PERIOD_S) % 25 == 7 else values[0]
        return values

    return changed


def test_what_follows_with_a_lag_spikes_gaps_or_a_small_error_is_never_off():
    for following in (
        *({"lag_s": lag_s} for lag_s in (0.0, 0.05, 0.1)),
        *({"change": spiky(value)} for value in (1e3, 1.5, math.nan)),
        {"change": one(4, lambda angle: angle + 0.03, 3.0)},
    ):
        assert not drive(**following)[1].any(), following


@pytest.mark.parametrize(
    ("place", "change"),
    [
        *(
            (0, lambda mps: 0.0),
            (1, lambda mps: 1.2 * mps),
            (2, lambda mps: 0.8 * mps),
            (0, lambda mps: -mps),
        ),
        *((1, lambda mps: 3.0), (3, lambda angle: angle + 0.1), (5, lambda angle: angle - 0.1)),
    ],
)
def test_what_does_not_follow_is_off_within_a_quarter_of_a_second_and_alone(place, change):
    time_s, off = drive(one(place, change, until_s=3.0))
    assert not np.delete(off, place, axis=1).any()
    assert not off[time_s < 2.0].any()
    assert off[(time_s >= 2.25) & (time_s < 3.0), place].all()
    assert not off[time_s > 3.5].any()


@pytest.mark.parametrize("change", [lambda mps: 0.0, lambda mps: 1.2 * mps])
def test_a_wheel_that_jumps_while_its_command_stays_is_a_spike_at_once_and_then_off(change):
    actuation, ones, found = Actuation(1.0, skids=True), np.ones(3), []
    for k in range(100):
        values = np.where([k < 60, True, True], ones, change(ones))[None]
        time_s = np.array([k * PERIOD_S])
        actuation.measured(k * PERIOD_S, PERIOD_S, Reading(time_s, values), np.zeros(3))
        actuation.commanded(ones, np.zeros(3))
        found.append((bool(actuation.spikes[0]), bool(actuation.off[0])))
    assert not np.any(found[:60])
    assert found[60] == (True, False)
    assert all(off for _, off in found[61:])


def test_what_stands_while_its_command_changes_is_off_and_what_is_not_measured_is_not():
    for place, frozen in ((1, 1.0), (5, 0.3)):
        time_s, off = drive(one(place, lambda value, frozen=frozen: frozen))
        assert off[time_s > 4.8, place].all()
        assert not off[time_s < 4.0].any()
        assert not np.delete(off, place, axis=1).any()

    def lost(time_s, values):
        return one(0, lambda mps: 0.0)(time_s, values) if time_s < 3.0 else None

    time_s, off = drive(lost)  # what was off before is over
    assert off[(time_s > 2.3) & (time_s < 3.0), 0].all()
    assert not off[time_s > 3.3].any()
