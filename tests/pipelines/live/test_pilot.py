"""The live chain: it never raises, reports its status, and improves the drive in the closed loop."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from pipelines.drive.faults import fault_loop
from pipelines.live.pilot import LivePilot
from terrain.control.fault_drives import LIMITS, FaultCase, Place, drive_case, drive_references, evaluate_case
from terrain.control.robot_control import CONTROLLERS, OPEN_LOOP, PilotSettings, braking_by_slip
from terrain.control.slip_table import CurveEntry, load_slip_table
from terrain.control.switching import OutputStatus, TerrainEstimate, TerrainSource
from terrain.control.traction import SETTINGS, TractionStatus
from terrain.errors import ConfigError
from terrain.estimation.health import Health
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run
from terrain.slip_learning.curve import LAW_PARAMETERS

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
DT_S = 0.02
NAN = math.nan


def pilot(controller="traction", **settings):
    return LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller, **settings))


@cache
def recorded(to_s=8.0):
    """Samples of the first part of a plain drive."""
    run = simulate_run(ROBOT, "grass", "straight", 7, duration_s=16.0)
    return [sample for sample in replay(run) if sample.time_s < to_s]


def test_without_readings_it_reports_so_and_fades_to_the_desired_speed():
    live, reference, twist = pilot(), pilot("plain"), np.array([0.6, 0.2, 0.1])
    for k in range(200):
        command = live.step(Sample(k * DT_S, twist, {"imu": Reading(None, None)}))
        plain = reference.step(Sample(k * DT_S, twist, {}))
        assert k <= 100 or command.status["status_code"] != TractionStatus.OK
    assert command.wheel_radps == pytest.approx(plain.wheel_radps)
    assert np.array_equal(command.steer_rad, plain.steer_rad)
    assert command.twist == pytest.approx(plain.twist)


@pytest.mark.parametrize("time_s", [NAN, 4.0, 5.6, 1e6, math.inf])
def test_a_wrong_clock_causes_no_jump_and_no_end_of_slip_control(time_s):
    """The clock of the steps is set once, for good or for a step; that of the streams is not."""
    live, offset_s = pilot(), 0.0
    for sample in recorded():
        if sample.time_s > 5.0 and offset_s == 0.0:
            before = live.step(sample._replace(time_s=time_s, twist=np.array([1.0, 0.0, 0.0])))
            offset_s = time_s - sample.time_s if math.isfinite(time_s) else 1e-6
            continue
        command = live.step(sample._replace(time_s=sample.time_s + offset_s))
        if 5.0 < sample.time_s < 5.3:
            rise = command.wheel_radps - before.wheel_radps
            assert (rise * ROBOT.wheel_radius_m <= SETTINGS.fade_mps2 * DT_S + 0.05).all()
            before = command
        if sample.time_s > 5.3:
            assert command.status["status_code"] == TractionStatus.OK
    again = live.step(sample._replace(time_s=sample.time_s + offset_s, readings={}))
    assert again.status["status_code"] == TractionStatus.BAD_TIME


@pytest.mark.parametrize(
    ("robot", "table", "settings", "message"),
    [
        ("agrimaro", {}, {"controller": "best"}, "controller 'best' is unknown: use one of plain, ramp"),
        ("agrimaro", {"robot": "o"}, {}, "slip table default: is of the robot 'o', not of 'agrimaro'"),
        ("agrimaro", {}, {"controller": "ramp", "ramp_mps2": 0.0}, "ramp_mps2 is 0.0"),
        ("agrimaro", {}, {"controller": "thesis", "delay_s": 1.5}, "delay_s is 1.5, 0 to 1 s is required"),
    ],
)
def test_invalid_settings_are_refused_in_one_sentence(robot, table, settings, message):
    with pytest.raises(ConfigError) as refused:
        LivePilot(load_robot(robot), replace(TABLE, **table), settings=PilotSettings(**settings))
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("follows", [True, False], ids=["driven", "watched"])
def test_a_wheel_that_does_not_follow_its_command_disagrees_unless_another_controller_drives(follows):
    live = pilot(follows=follows)
    for sample in recorded():
        readings = dict(sample.readings)
        if "wheels" in readings and sample.time_s > 5.0:
            values = readings["wheels"].values.copy()
            values[:, 1] *= 0.5
            readings["wheels"] = Reading(readings["wheels"].time_s, values)
        live.step(sample._replace(readings=readings))
    assert (live.health["wheel_2"] == "disagrees") is follows
    assert (live.estimate.health[live.control.sensors.index("wheel_2")] == Health.LOST) == follows


def test_a_classifier_whose_probability_never_suffices_is_reported_and_one_that_ends_not_believed_for_long():
    for probability, output in ((0.45, OutputStatus.BELOW_THRESHOLD), (0.9, OutputStatus.ACCEPTED)):
        source = TerrainSource()
        source.update = lambda sample, _, p=probability: [TerrainEstimate(sample.time_s, "grass", p)]
        live = LivePilot(ROBOT, TABLE, source)
        statuses = [live.step(Sample(k / 50, np.zeros(3), {})).status for k in range(100)]
        assert {status["output_code"] for status in statuses} == {output}
        assert (live.belief.terrain == "grass") is (output is OutputStatus.ACCEPTED)
    source.update, source.outputs = lambda sample, _: [], [SimpleNamespace(refused="Input contains NaN.")]
    assert live.step(Sample(2.0, np.zeros(3), {})).status["output_code"] == OutputStatus.REFUSED
    for sample in recorded(15.0):
        live.step(sample._replace(time_s=sample.time_s + 2.0))
    assert (live.belief.terrain, live.step(sample).status["terrain_code"]) == ("", -1.0)


# Sensors that fail in the closed loop: plain commands are no better


def slick_table():
    """A table with the curve that is learned on ``wet_floor``, whose thrust falls beyond its peak."""
    named = dict(zip(LAW_PARAMETERS["magic"], (16.50, 1.431, 0.262, -0.903), strict=True))
    numbers = (0.09, (0.078, 0.102), "peak", (0.0, 0.6), 0.012, 0.004, 0.002, 0.08, 0.9, 168.0, -203.0)
    curves = {"wet_floor": CurveEntry("magic", named, *numbers, 17.9, 8)}
    targets = {state: target._replace(terrain="wet_floor") for state, target in TABLE.lookup("").items()}
    return replace(TABLE, targets={**TABLE.targets, "wet_floor": targets}, curves=curves)


SLICK = slick_table()
LOOP = fault_loop(ROBOT, SLICK)
STOP, START, STEADY = (
    Place(*place, 400) for place in (("stop", "wet_floor"), ("start", "grass"), ("steady", "grass"))
)


@cache
def references(place):
    return drive_references(LOOP, place)


@cache
def row(fault, place, duration_s=3.0):
    return evaluate_case(LOOP, FaultCase(fault, duration_s, *place), references(place))


LOSSES = ("loss_all", "loss_wheels", "freeze_wheels", "freeze_camera_speed", "freeze_pitch")
STEPS = ("step_camera_speed", "step_camera_speed_down", "step_pitch")
SLOW = [*((fault, math.inf) for fault in LOSSES), *((fault, 3.0) for fault in STEPS)]


@pytest.mark.parametrize(
    ("fault", "duration_s"),
    [("freeze_wheels", 3.0), *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)],
)
def test_a_fault_at_the_brake_on_slick_ground_ends_the_braking_by_slip(fault, duration_s):
    clean, plain, _ = references(STOP)
    assert braking_by_slip(SLICK.curves["wet_floor"]) is not None
    assert clean.stop_m < 0.95 * plain.stop_m, "by slip it stops sooner than with locked wheels"
    found = row(fault, STOP, duration_s).figures
    assert found.stop_ratio <= LIMITS.stop_ratio
    assert found.overspeed_s <= LIMITS.overspeed_s
    assert found.ok_total_s <= LIMITS.ok_s
    assert (found.n_exceptions, found.n_not_finite) == (0, 0)


PLACES = pytest.mark.parametrize("place", [START, pytest.param(STEADY, marks=pytest.mark.slow)])


@PLACES
@pytest.mark.parametrize(
    ("fault", "ok_ratio", "error_ratio"),
    [
        ("behind_odometry", 0.95, 0.05),
        ("late_150ms_odometry", 0.8, 0.09),  # what a start on grass changes slip by in that time
        *((f"clock_{which}_all", 0.95, 0.05) for which in ("back", "forward")),
    ],
)
def test_stamps_or_samples_that_are_late_or_of_a_clock_that_was_set_cost_little(
    fault, ok_ratio, error_ratio, place
):
    found = row(fault, place).figures
    assert found.ok_total_s >= ok_ratio * 2.98
    assert found.slip_error_ratio <= error_ratio
    assert found.slip_peak_ratio <= found.plain_slip_peak_ratio


@PLACES
def test_lost_wheels_are_named_and_nothing_winds_up_meanwhile(place):
    found, (clean, _, start_s) = row("loss_wheels", place), references(place)
    assert found.figures.ok_total_s <= LIMITS.ok_s
    assert found.figures.recovery_s <= LIMITS.recovery_s
    wheels = {"wheel_1", "wheel_2", "wheel_3"}
    assert {sensor for sensor in found.sensors_named if sensor.startswith("wheel")} == wheels
    drive = drive_case(LOOP, FaultCase("loss_wheels", 3.0, *place))[0]
    after = drive.time_s > start_s + 3.0
    peak, clean_peak = (np.nanmax(np.abs(d.true_slip_ratio[after])) for d in (drive, clean))
    assert peak <= clean_peak + 0.03


# Whatever arrives: no exception, no command that is not finite


class Hostile:
    """An object that fails wherever it is touched."""

    def __array__(self, *args, **kwargs):
        raise RuntimeError("not an array")

    def __float__(self):
        raise RuntimeError("not a number")


def odd(rng, time_s, width):
    """One of many things that are no stamps or values, or are."""
    k = int(rng.integers(0, 4))
    things = (
        time_s + rng.choice([0.0, 3600.0, -3600.0, 1e300]) + 0.005 * np.arange(k),
        rng.standard_normal((k, width + int(rng.integers(0, 2)))),
        10.0 ** rng.uniform(-300, 300, (k, width)),
        np.full((k, width), rng.choice([np.nan, np.inf, -np.inf])),
        *(np.zeros((k, width, 2)), np.zeros((k, width), complex), np.full((k, width), None)),
        *([["much"] * width] * k, [[0.0], [0.0, 1.0]], None, 10**400, Hostile(), "wheels", {"a": 1}),
    )
    return things[int(rng.integers(len(things)))]


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_odd_samples_of_each_controller_neither_raise_nor_command_nonsense(controller, survey):
    rng, sound = np.random.default_rng(7), list(replay(survey))
    live = pilot(controller, track=controller == "traction")
    with np.errstate(all="ignore"):
        for k in range(300 if controller in OPEN_LOOP else 900):
            sample = sound[k % len(sound)]
            time_s, readings = sample.time_s, dict(sample.readings)
            for name, width in {"wheels": 6, "steering": 3, "imu": 9, "odometry": 14}.items():
                if rng.random() < 0.4:
                    readings[name] = Reading(odd(rng, time_s, width), odd(rng, time_s, width))
            twist, others = rng.choice([NAN, math.inf, 9.0], 3), odd(rng, 9.0, 3)
            parts = ((time_s, sample.twist), (time_s, twist), (odd(rng, time_s, 1), sample.twist))[k % 3]
            command = live.step(Sample(*parts, readings if k % 20 else others, odd(rng, time_s, 1)))
            assert len(command.status) == 18
            for figures in (command.wheel_radps, command.steer_rad, command.twist):
                assert figures.shape == (3,)
                assert np.isfinite(figures).all()
        assert np.isfinite(live.step(odd(rng, time_s, 1)).wheel_radps).all()
