"""The PID step against its linear form, and the thesis' controller against table 8.1, in any drive and on grass."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrain.control.car_following import SteeringSettings, check_steering
from terrain.control.pid import LONGEST_STEP_S, Gains, WheelPid, pid_step, wheel_step
from terrain.control.slip_table import DRIVE_STATES
from terrain.control.switching import SWITCHING, check_switching
from terrain.errors import ConfigError

DT_S, NAN = 0.02, math.nan


def outputs(gains, errors):
    found, integral = [], 0.0
    for error in errors:
        output, integral, is_clamped = pid_step(gains, integral, float(error), DT_S)
        found.append((output, integral, is_clamped))
    return found


def test_within_its_limits_it_is_the_linear_filter():
    error = np.random.default_rng(0).standard_normal(500)
    expected = 1.5 * error + 0.7 * DT_S * np.cumsum(error)
    assert [output for output, *_ in outputs(Gains(1.5, 0.7, 1e9), error)] == pytest.approx(
        expected, abs=1e-10
    )


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60),
    st.tuples(st.floats(0, 10), st.floats(0, 100), st.floats(0.01, 10), st.floats(0.01, 20)),
)
def test_output_and_integral_keep_their_limits_and_do_not_wind_up(errors, numbers):
    gains, before = Gains(*numbers), 0.0
    for error, (output, integral, is_clamped) in zip(errors, outputs(gains, errors), strict=True):
        assert abs(output) == gains.limit if is_clamped else abs(output) <= gains.limit
        assert abs(integral) <= gains.integral_limit
        if is_clamped and output * error > 0:
            assert abs(integral) <= abs(before)
        before = integral


def test_a_fault_gives_nothing_and_keeps_the_integral():
    late = np.nextafter(LONGEST_STEP_S, 1.0)
    faults = [(error, DT_S) for error in (NAN, math.inf, -math.inf)]
    for error, dt_s in (*faults, *((1.0, dt_s) for dt_s in (0.0, -0.02, NAN, late))):
        assert pid_step(Gains(1.0, 1.0, 100.0), 0.3, error, dt_s) == (0.0, 0.3, False)


CHECKS = {"switching: ": (check_switching, SWITCHING), "steering: ": (check_steering, SteeringSettings())}
ZERO_UP = "from zero up"


@pytest.mark.parametrize(
    ("what", "name", "value", "accepted"),
    [
        *(("switching: ", "silent_s", value, ZERO_UP) for value in (math.inf, True, "1")),
        *(("switching: ", "probability_least", value, "from 0 to 1") for value in (1.01, NAN)),
        *(("steering: ", "position_pm2", 0.0, "above zero"), ("steering: ", "delay_s", -1.0, "from 0 to 2")),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_sentence(what, name, value, accepted):
    check, settings = CHECKS[what]
    check(settings)
    with pytest.raises(ConfigError) as refused:
        check(settings._replace(**{name: value}))
    assert str(refused.value) == f"{what}{name} is {value!r}, a number {accepted} is required"


TARGETS = (0.1, -0.15, 0.05)
TABLE = """
1A +0.6 +0.7  +0.143 +0.100 -0.043 +0.657
1B +0.6 +0.63 +0.048 +0.100 +0.052 +0.682
1C +0.5 +0.47 -0.060 -0.150 -0.090 +0.380
1D +0.5 +0.39 -0.220 -0.150 +0.070 +0.460
2A -0.6 -0.7  -0.143 -0.100 +0.043 -0.657
2B -0.6 -0.63 -0.048 -0.100 -0.052 -0.682
2C -0.5 -0.47 +0.060 +0.150 +0.090 -0.380
2D -0.5 -0.39 +0.220 +0.150 -0.070 -0.460
"""
ROWS = [line.split() for line in TABLE.split("\n") if line]
CASES = [pytest.param(*row, id=row[0]) for row in ROWS]


def step(gains, state, rate, speed, accel, *, command=None, radius_m=0.2):
    """One step of a wheel, and its state."""
    given = rate if command is None else command, rate, speed, accel, abs(speed), TARGETS, DT_S
    return wheel_step(gains, radius_m, state, *given)


def wheels_step(gains, states, rows, chassis, targets, dt_s):
    """One step of all wheels of AgriMaRo, rows (3,) of command, rate, speed and acceleration."""
    columns = zip(*(row.tolist() for row in rows), strict=True)
    given = zip(states, columns, strict=True)
    steps = [wheel_step(gains, 0.2, state, *row, chassis, targets, dt_s) for state, row in given]
    return [step for step, _ in steps], [state for _, state in steps]


def accel_of(case, speed):
    """Along the motion in traction (A, B), against it in braking (C, D)."""
    return math.copysign(1.0, speed) * (1.0 if case[1] in "AB" else -1.0)


@pytest.mark.parametrize(("case", "speed", "rate", "slip", "desired", "error", "sent"), CASES)
def test_in_the_cases_of_table_8_1_half_of_an_error_remains(case, speed, rate, slip, desired, error, sent):
    """Each command is the wheel's rate at the next step; the ground speed is held."""
    state, v, w, errors = WheelPid(), float(speed), float(rate), []
    for _ in range(60):
        found, state = step(Gains(0.5, 0.0, limit=10.0), state, w, v, accel_of(case, v), radius_m=1.0)
        assert f"{found.desired_ratio:+.3f}" == desired
        assert DRIVE_STATES[found.drive_state] == ("traction" if case[1] in "AB" else "braking")
        errors.append(found.desired_ratio - (w - v) / max(abs(w), abs(v)))
        w += found.correction_radps
    left = np.divide(errors[1:20], errors[:19])
    assert abs(errors[-1]) < 1e-12
    most = 0.5 + (1e-6 if case[1] in "CD" else 0.065)
    assert ((left > 0.5 - 1e-6) & (left < most)).all()


def test_any_drive_with_faults_is_mirror_symmetric_and_keeps_its_integral_meanwhile():
    rng = np.random.default_rng(1)
    gains = Gains(0.6, 2.0, 1.5, 1.2)
    states, mirrored = [WheelPid()] * 3, [WheelPid()] * 3
    for k in range(1000):
        direction = math.sin(k / 60)
        speed = direction + 0.05 * rng.standard_normal(3)
        wheels = np.array([direction / 0.2 + 0.3 * rng.standard_normal(3) for _ in range(2)])
        accel, chassis, dt_s = rng.standard_normal(3), abs(direction), DT_S
        if k % 7 == 0:
            speed[rng.integers(3)] = rng.choice([NAN, 0.0])
            wheels[rng.integers(2), rng.integers(3)] = rng.choice([NAN, 0.0])
            accel[rng.integers(3)] = NAN
        if k % 31 == 0:
            chassis, dt_s = rng.choice([[NAN, 0.02], [1.0, rng.choice([NAN, 0.0, -0.1, 0.6])]])
        given = (wheels[0], wheels[1], speed, accel)
        kept = states
        found, states = wheels_step(gains, states, given, chassis, TARGETS, dt_s)
        other, mirrored = wheels_step(gains, mirrored, [-a for a in given], chassis, TARGETS, dt_s)
        for one, reflected, before, state, image in zip(found, other, kept, states, mirrored, strict=True):
            assert one.drive_state == reflected.drive_state
            assert np.array_equal(one[:2], -np.array(reflected[:2]), equal_nan=True)
            assert state.direction == -image.direction
            assert state.integral == -image.integral
            if math.isnan(one.desired_ratio) or not dt_s > 0.0:
                assert one.correction_radps == 0.0
                assert state.integral in (0.0, before.integral)


def test_a_wheel_that_rolls_against_its_command_is_not_corrected_and_its_integral_is_reset():
    gains = Gains(0.5, 5.0, 5.0)
    state = WheelPid()
    for _ in range(20):
        _, state = step(gains, state, 5.0, 0.7, 0.0)
    assert state.integral < 0
    found, state = step(gains, state, 2.0, 0.5, -1.0, command=-5.0)
    assert found.correction_radps == 0.0
    assert (state.integral, state.direction) == (0.0, -1.0)
    found, state = step(gains, state, -5.0, -0.7, 0.0, command=-5.0)
    assert found.desired_ratio == -0.05
    assert found.correction_radps > 0  # turns back more slowly
