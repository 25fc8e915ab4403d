import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.control.danzi_pid import (
    FORMS,
    DriveState,
    ThesisStatus,
    new_state,
    power_state,
    thesis_settings,
    thesis_step,
)
from terrain.control.pid import Gains, PidState, pid_step
from terrain.control.slip_table import DRIVE_STATES
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.conditions import Conditions
from terrain.simulation.dynamic.plant import make_plant, start_state, uniform_profile
from terrain.simulation.dynamic.step import advance
from terrain.simulation.sensors import BODY_ROW
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import equilibrium_slip

ROBOT = load_robot("agrimaro")
DT_S = 0.02
NAN = math.nan
PROPORTIONAL = Gains(1.0, 0.0, 0.0, limit=10.0)
TARGETS = np.array([0.1, -0.15, 0.05])
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


def step(settings, state, rate, speed, accel, *, command=None, chassis=None, targets=TARGETS, dt_s=DT_S):
    """One step of three equal wheels; what comes back of the first, and the state."""
    wheels = [np.full(3, value) for value in (rate if command is None else command, rate, speed, accel)]
    chassis = abs(speed) if chassis is None else chassis
    *found, state = thesis_step(settings, state, *wheels, chassis, targets, dt_s)
    assert all((values == values[0]).all() or np.isnan(values).all() for values in found)
    return *(values[0] for values in found), state


def accel_of(case, speed):
    """Along the motion in traction (A, B), against it in braking (C, D)."""
    return math.copysign(1.0, speed) * (1.0 if case[1] in "AB" else -1.0)


@pytest.mark.parametrize(("case", "speed", "rate", "slip", "desired", "error", "sent"), CASES)
def test_the_printed_form_gives_table_8_1(case, speed, rate, slip, desired, error, sent):
    settings = thesis_settings(1.0, PROPORTIONAL, "printed")
    v, w = float(speed), float(rate)
    added, signal, drive_state, status, _ = step(settings, new_state(), w, v, accel_of(case, v))
    assert [f"{value:+.3f}" for value in (signal - added, signal, added, w + added)] == [
        slip,
        desired,
        error,
        sent,
    ]
    assert DRIVE_STATES[drive_state] == ("traction" if case[1] in "AB" else "braking")
    assert status == ThesisStatus.OK


def iterated(form, gain, case, speed, rate, steps):
    """Errors of steps in which each command is the wheel's rate at the next; the ground speed is held."""
    settings = thesis_settings(1.0, PROPORTIONAL._replace(kp=gain), form)
    state, v, w, errors = new_state(), float(speed), float(rate), []
    for _ in range(steps):
        added, desired, _, _, state = step(settings, state, w, v, accel_of(case, v))
        errors.append(desired - (w - v) / max(abs(w), abs(v)))
        w += added
    return np.array(errors)


@pytest.mark.parametrize(("case", "speed", "rate"), [row[:3] for row in ROWS])
def test_iterated_the_printed_form_oscillates_in_braking_and_the_normalised_one_converges(case, speed, rate):
    printed = iterated("printed", 1.0, case, speed, rate, 1000)
    if case[1] in "CD":
        assert printed == pytest.approx(printed[0] * (-1.0) ** np.arange(1000), rel=1e-6)
    else:
        assert abs(printed[-1]) < 1e-9
    error = iterated("normalised", 0.5, case, speed, rate, 60)
    left = error[1:20] / error[:19]
    assert abs(error[-1]) < 1e-12
    if case[1] in "CD":
        assert left == pytest.approx(0.5, abs=1e-6)
    else:
        assert (left > 0.5).all()
        assert (left < 0.565).all()


@pytest.mark.parametrize("radius_m", [0.1, 0.4])
@pytest.mark.parametrize("speed", [0.1, 1.0, -2.0])
def test_the_normalised_form_removes_the_same_fraction_of_an_error_at_any_speed_and_radius(speed, radius_m):
    settings = thesis_settings(radius_m, PROPORTIONAL._replace(kp=0.5, limit=1e3))
    rate = 0.8 * speed / radius_m  # braking: a slip of 0.2, 0.05 too much
    added, *_ = step(settings, new_state(), rate, speed, -3 * speed / speed**2)
    assert (0.8 * speed + added * radius_m) / speed == pytest.approx(0.825)


def plain(settings, state, command, wheel, speed, accel, chassis, targets, dt_s):
    """The step for one wheel without compiled code; ``state`` is (PidState, direction)."""
    pid, direction = state
    r, low = settings.wheel_radius_m, settings.low_speed_mps
    normalised = FORMS[settings.form] == "normalised"
    commanded = 0 if abs(command * r) <= low or math.isnan(command) else math.copysign(1, command)
    if commanded and commanded != direction:
        direction, pid = commanded, PidState(0.0 if normalised else pid.integral, pid.error)
    fastest = NAN if math.isnan(wheel + speed) else max(abs(wheel * r), abs(speed))
    slip = 0.0 if fastest < low else (wheel * r - speed) / fastest if fastest else NAN
    power = accel * speed
    limit = settings.power_threshold_wpkg
    kind = DriveState.STEADY
    if math.isnan(power):
        kind = DriveState.UNKNOWN
    elif abs(power) > limit:
        kind = DriveState.TRACTION if power > 0 else DriveState.BRAKING
    sign = direction if normalised else np.sign(speed)
    desired = NAN if kind == DriveState.UNKNOWN else sign * targets[kind]
    error = desired - slip
    untouched = PidState(pid.integral, NAN), direction
    if not 0 < dt_s <= 0.5:
        return 0.0, desired, kind, ThesisStatus.BAD_TIME, untouched
    if math.isnan(error + chassis):
        return 0.0, desired, kind, ThesisStatus.NO_ERROR, untouched
    if chassis <= settings.chassis_speed_mps:
        return 0.0, desired, kind, ThesisStatus.STANDING, untouched
    if normalised and abs(speed) >= low and np.sign(speed) != direction:
        return 0.0, desired, kind, ThesisStatus.REVERSING, untouched
    if abs(speed) < low:
        added, pid, _ = pid_step(settings.gains, pid, 0.0, dt_s)
        return added, desired, kind, ThesisStatus.LOW_SPEED, (pid, direction)
    added, pid, status = pid_step(settings.gains, pid, error * (fastest / r if normalised else 1), dt_s)
    return added, desired, kind, status, (pid, direction)


@pytest.mark.parametrize("form", FORMS)
def test_any_drive_with_faults_equals_the_reference_and_its_mirror_image(form):
    rng = np.random.default_rng(1)
    settings = thesis_settings(0.2, Gains(0.6, 2.0, 0.01, 1.5, 1.2, 0.05), form)
    state, mirrored = new_state(), new_state()
    oracle = [(PidState(), 0.0)] * 3
    seen = set()
    for k in range(3000):
        direction = math.sin(k / 60)
        speed = direction + 0.05 * rng.standard_normal(3)
        wheels = np.array([direction / 0.2 + 0.3 * rng.standard_normal(3) for _ in range(2)])
        accel = rng.standard_normal(3)
        chassis, dt_s, targets = abs(direction), DT_S, TARGETS.copy()
        if k % 7 == 0:
            speed[rng.integers(3)] = rng.choice([NAN, 0.0])
            wheels[rng.integers(2), rng.integers(3)] = rng.choice([NAN, 0.0])
            accel[rng.integers(3)] = NAN
        if k % 31 == 0:
            chassis, dt_s, targets[rng.integers(3)] = rng.choice(
                [[NAN, 0.02, 0.1], [1.0, rng.choice([NAN, 0.0, -0.1, 0.6]), 0.1], [1.0, 0.02, NAN]]
            )
        given = (wheels[0], wheels[1], speed, accel)
        for array in (*given, targets, state):
            array.flags.writeable = False
        *found, after = thesis_step(settings, state, *given, chassis, targets, dt_s)
        for i in range(3):
            *expected, oracle[i] = plain(settings, oracle[i], *(a[i] for a in given), chassis, targets, dt_s)
            assert [values[i] for values in found] == pytest.approx(expected, nan_ok=True, abs=1e-12), k
            assert after[:, i] == pytest.approx([*oracle[i][0], oracle[i][1]], nan_ok=True, abs=1e-12), k
        *other, mirrored = thesis_step(settings, mirrored, *(-a for a in given), chassis, targets, dt_s)
        for value, reflected in zip(found[:2], other[:2], strict=True):
            assert np.array_equal(value, -reflected, equal_nan=True)
        assert all(np.array_equal(*pair) for pair in zip(found[2:], other[2:], strict=True))
        state = after
        seen |= {int(code) for code in found[3]}
    reached = {
        ThesisStatus.OK,
        ThesisStatus.CLAMPED,
        ThesisStatus.BAD_TIME,
        ThesisStatus.NO_ERROR,
        ThesisStatus.LOW_SPEED,
        ThesisStatus.STANDING,
        ThesisStatus.REVERSING,
    }
    assert seen == reached - ({ThesisStatus.REVERSING} if form == "printed" else set())


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"rate": NAN}, ThesisStatus.NO_ERROR),
        ({"speed": NAN, "chassis": 1.0}, ThesisStatus.NO_ERROR),
        ({"accel": NAN}, ThesisStatus.NO_ERROR),
        ({"chassis": NAN}, ThesisStatus.NO_ERROR),
        ({"targets": np.full(3, NAN)}, ThesisStatus.NO_ERROR),
        ({"dt_s": 0.51}, ThesisStatus.BAD_TIME),
        ({"chassis": 0.05}, ThesisStatus.STANDING),
    ],
)
def test_without_valid_inputs_nothing_is_added_and_the_integral_is_kept(form, changes, expected):
    settings = thesis_settings(0.2, Gains(0.5, 5.0, 0.1, 5.0), form)
    drive = {"rate": 5.0, "speed": 0.7, "accel": 0.0, "command": 5.0}
    *_, state = step(settings, new_state(), **drive)
    assert state[0, 0] != 0.0
    added, _, _, status, after = step(settings, state, **drive | changes)
    assert (added, status) == (0.0, expected)
    assert np.array_equal(after[[0, 2]], state[[0, 2]])


def test_at_rest_noise_changes_the_sign_of_the_desired_slip_of_the_printed_form_only():
    rng = np.random.default_rng(2)
    turned = {}
    for form in FORMS:
        settings = thesis_settings(0.2, PROPORTIONAL, form)
        *_, state = step(settings, new_state(), 5.0, 0.9, 0.0)
        signals = []
        for _ in range(200):
            speed, command = 0.003 * rng.standard_normal(2)
            added, desired, _, status, state = step(settings, state, 0.0, speed, 0.0, command=command)
            assert (added, status) == (0.0, ThesisStatus.STANDING)
            signals.append(desired)
        turned[form] = int((np.diff(signals) != 0).sum())
    assert turned["printed"] > 50
    assert turned["normalised"] == 0


def test_a_wheel_that_rolls_against_its_command_is_not_corrected_and_its_integral_is_reset():
    settings = thesis_settings(0.2, Gains(0.5, 5.0, 0.0, 5.0))
    state = new_state()
    for _ in range(20):
        *_, state = step(settings, state, 5.0, 0.7, 0.0)
    assert state[0, 0] < 0
    added, _, _, status, state = step(settings, state, 2.0, 0.5, -1.0, command=-5.0)
    assert (added, status, state[0, 0], state[2, 0]) == (0.0, ThesisStatus.REVERSING, 0.0, -1.0)
    added, desired, _, status, state = step(settings, state, -5.0, -0.7, 0.0, command=-5.0)
    assert (desired, status) == (-0.05, ThesisStatus.OK)
    assert added > 0  # turns back more slowly


def test_power_at_the_threshold_is_steady():
    states = [power_state(accel, 0.5, 0.1) for accel in (0.2, 0.2000001, -0.2, -0.2000001, NAN)]
    assert states == [
        DriveState.STEADY,
        DriveState.TRACTION,
        DriveState.STEADY,
        DriveState.BRAKING,
        DriveState.UNKNOWN,
    ]
    assert [
        DRIVE_STATES[state] for state in (DriveState.TRACTION, DriveState.BRAKING, DriveState.STEADY)
    ] == list(DRIVE_STATES)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"form": "new"}, "form 'new' is unknown: use one of printed, normalised"),
        ({"wheel_radius_m": 0.0}, "wheel_radius_m is 0.0"),
        ({"low_speed_mps": NAN}, "low_speed_mps is nan"),
        ({"chassis_speed_mps": -1.0}, "chassis_speed_mps is -1.0"),
        ({"power_threshold_wpkg": math.inf}, "power_threshold_wpkg is inf"),
        ({"gains": Gains(1.0, 0.0, 0.0, 0.0)}, "gain limit is 0.0"),
    ],
)
def test_invalid_settings_are_refused_in_one_sentence(arguments, message):
    with pytest.raises(ConfigError) as refused:
        thesis_settings(**{"wheel_radius_m": 0.2, "gains": PROPORTIONAL} | arguments)
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


def driven(settings, target, duration_s=60.0, wheel_speed_mps=1.0, delay_rows=50):
    """Return the speed over ground (n,) each millisecond: level grass, the truth fed back 50 ms late."""
    substeps = round(DT_S * 1000)
    plant, profile = make_plant(ROBOT, Conditions()), uniform_profile(ROBOT, load_soil("grass"))
    state, memory, n = start_state(np.zeros(3)), new_state(), round(duration_s / DT_S)
    record = np.zeros(n * substeps, BODY_ROW)
    speed, accel, rate = record["speed_x_mps"], record["accel_x_mps2"], record["wheels"]["wheel_radps"]
    targets, still = np.array([target, -0.15, target]), np.zeros((1, 3))
    for k in range(n):
        command, added = np.full(3, min(k * DT_S, 1.0) * wheel_speed_mps / ROBOT.wheel_radius_m), np.zeros(3)
        seen = k * substeps - 1 - delay_rows
        if seen >= 0:
            v, a = np.full(3, speed[seen]), np.full(3, accel[seen])
            added, _, _, _, memory = thesis_step(
                settings, memory, command, rate[seen], v, a, abs(speed[seen]), targets, DT_S
            )
        rows = slice(k * substeps, (k + 1) * substeps)
        sent, noise = (command + added)[None], np.zeros((substeps, 3))
        advance(plant, profile, state, sent, still, substeps, noise, record[rows])
    return speed


def test_on_grass_a_target_below_the_balance_slip_stops_the_robot_and_one_above_it_runs_away():
    body = ROBOT.body
    load_n = ROBOT.mass_kg / 3 * GRAVITY_MPS2
    geometry = ROBOT.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    balance = equilibrium_slip(load_soil("grass"), load_n, 0.0, *geometry)
    assert balance == pytest.approx(0.126, abs=0.001)
    free_mps = 1.0 - balance
    clamp_radps = 5.0  # a whole 1 m/s of wheel speed in either direction
    for form, gains in {
        "normalised": Gains(0.5, 0.5, 0.0, clamp_radps),
        "printed": Gains(1.0, 1.0, 0.0, clamp_radps),
    }.items():
        settings = thesis_settings(ROBOT.wheel_radius_m, gains, form)
        assert driven(settings, 0.05)[-1000:].mean() < 0.5 * free_mps
        assert driven(settings, 0.2)[-1000:].mean() > 1.5 * free_mps
    settings = thesis_settings(ROBOT.wheel_radius_m, Gains(0.5, 0.5, 0.0, clamp_radps))
    assert driven(settings, balance)[-1000:].mean() == pytest.approx(free_mps, rel=0.1)
