"""Sensors that fail in the closed loop: the pilot says so, and plain commands are no better; whatever arrives."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.drive.faults import fault_loop
from pipelines.live.pilot import LivePilot
from terrain.control.fault_drives import FaultCase, Place, drive_case, drive_references, evaluate_case
from terrain.control.fault_evaluation import LIMITS
from terrain.control.pilot_settings import CONTROLLERS, PilotSettings, PilotStatus
from terrain.control.slick import braking_by_slip
from terrain.control.slip_table import CurveEntry, load_slip_table
from terrain.control.switching import OutputStatus
from terrain.control.terrain_source import TerrainEstimate, TerrainSource
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot
from terrain.slip_learning.laws import LAW_PARAMETERS

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()


def slick_table():
    """A table with the curve that is learned on ``wet_floor``, whose thrust falls beyond its peak."""
    named = dict(zip(LAW_PARAMETERS["magic"], (16.50, 1.431, 0.262, -0.903), strict=True))
    numbers = (0.09, (0.078, 0.102), "peak", (0.0, 0.6), 0.012, 0.004, 0.002, 0.08, None, 0.9, 168.0, -203.0)
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


def test_without_a_fault_braking_by_slip_stops_sooner_than_locked_wheels():
    assert braking_by_slip(SLICK.curves["wet_floor"]) is not None
    clean, plain, _ = references(STOP)
    assert clean.stop_m < 0.95 * plain.stop_m


LOSSES = ("loss_all", "loss_wheels", "freeze_wheels", "freeze_camera_speed", "freeze_pitch")
STEPS = ("step_camera_speed", "step_camera_speed_down", "step_pitch")


@pytest.mark.slow
@pytest.mark.parametrize("duration_s", [3.0, math.inf])
@pytest.mark.parametrize("fault", [*LOSSES, *STEPS])
def test_a_fault_at_the_brake_on_slick_ground_ends_the_braking_by_slip(fault, duration_s):
    found = row(fault, STOP, duration_s).figures
    assert found.stop_ratio <= LIMITS.stop_ratio
    assert found.overspeed_s <= LIMITS.overspeed_s
    assert found.ok_total_s <= LIMITS.ok_s
    assert (found.n_exceptions, found.n_not_finite) == (0, 0)


@pytest.mark.parametrize("place", [START, STEADY])
@pytest.mark.parametrize(
    ("fault", "ok_ratio", "error_ratio"),
    [
        ("behind_odometry", 0.95, 0.05),
        ("behind_steering", 0.95, 0.05),
        ("late_150ms_odometry", 0.8, 0.09),  # what a start on grass changes slip by in that time
    ],
)
def test_stamps_or_samples_that_are_late_cost_little(fault, ok_ratio, error_ratio, place):
    found = row(fault, place).figures
    assert found.ok_total_s >= ok_ratio * 2.98
    assert found.slip_error_ratio <= error_ratio
    assert found.slip_peak_ratio <= found.plain_slip_peak_ratio


STREAMS = ("wheels", "steering", "imu", "odometry")


@pytest.mark.parametrize("stream", [*(pytest.param(name, marks=pytest.mark.slow) for name in STREAMS), "all"])
@pytest.mark.parametrize("which", ["back", "forward"])
def test_a_clock_that_is_set_by_an_hour_costs_a_moment(stream, which):
    found = row(f"clock_{which}_{stream}", STEADY).figures
    assert found.not_ok_s <= 0.1
    assert found.recovery_s <= 0.1
    assert found.slip_error_ratio <= 0.05


@pytest.mark.parametrize("stream", STREAMS)
def test_a_clock_that_was_set_is_counted_by_its_stream(stream):
    driven = drive_case(LOOP, FaultCase(f"clock_back_{stream}", math.inf, *STEADY))
    counts = driven.pilot._pilot.dropped
    assert {kind: n for kind, n in counts.items() if "clock set" in kind} == {f"{stream}: clock set": 1}


@pytest.mark.parametrize("place", [START, STEADY])
def test_lost_wheels_are_named_and_nothing_winds_up_meanwhile(place):
    found, (clean, _, start_s) = row("loss_wheels", place), references(place)
    assert found.figures.ok_total_s <= LIMITS.ok_s
    assert found.figures.recovery_s <= LIMITS.recovery_s
    wheels = {"wheel_1", "wheel_2", "wheel_3"}
    assert {sensor for sensor in found.blamed if sensor.startswith("wheel")} == wheels
    drive = drive_case(LOOP, FaultCase("loss_wheels", 3.0, *place)).drive
    after = drive.time_s > start_s + 3.0
    peak, clean_peak = (np.nanmax(np.abs(d.true_slip_ratio[after])) for d in (drive, clean))
    assert peak <= clean_peak + 0.03


@pytest.mark.parametrize(
    ("probability", "output", "believed"),
    [(0.45, OutputStatus.BELOW_THRESHOLD, False), (0.9, OutputStatus.ACCEPTED, True)],
)
def test_a_classifier_whose_probability_never_suffices_is_reported(probability, output, believed):
    source = TerrainSource()
    source.update = lambda sample, _: [TerrainEstimate(sample.time_s, "grass", probability)][
        sample.time_s % 2 > 0 :
    ]
    pilot, twist = LivePilot(ROBOT, TABLE, source), np.array([0.5, 0.0, 0.0])
    statuses = [pilot.step(Sample(k / 50, twist, {})).status for k in range(1000)]
    outputs = [status["output_code"] for status in statuses if status["output_code"]]
    assert set(outputs) == {output}
    assert len(outputs) >= 8
    assert (statuses[-1]["terrain_code"] >= 0) is believed


# Whatever arrives: no exception, no command that is not finite

WIDTH = {"wheels": 6, "steering": 3, "imu": 9, "odometry": 14}


class Hostile:
    """An object that fails wherever it is touched."""

    def __array__(self, *args, **kwargs):
        raise RuntimeError("not an array")

    def __float__(self):
        raise RuntimeError("not a number")

    def __len__(self):
        raise RuntimeError("no length")


def odd_value(rng, width):
    """One of many things that are no values (k, width), or are."""
    k = int(rng.integers(0, 4))
    things = (
        rng.standard_normal((k, width)),
        rng.standard_normal((k, width + int(rng.integers(1, 3)))),
        10.0 ** rng.uniform(-300, 300, (k, width)),
        np.full((k, width), rng.choice([np.nan, np.inf, -np.inf])),
        rng.integers(-9, 9, (k, width)),
        *(np.zeros((k, width, 2)), np.zeros(width), np.zeros((k, width), complex), np.full((k, width), None)),
        *([["much"] * width] * k, [[0.0], [0.0, 1.0]], None, 10**400, Hostile(), "wheels", {"a": 1}),
    )
    return things[int(rng.integers(len(things)))]


def odd_stamp(rng, time_s):
    """One of many things that are no stamps (k,), or are."""
    k = int(rng.integers(0, 4))
    things = (
        time_s + 0.005 * np.arange(k),
        time_s - rng.uniform(0, 0.5, k),
        time_s + rng.choice([3600.0, -3600.0, 1e300, -1e300]) + 0.005 * np.arange(k),
        np.full(k, rng.choice([np.nan, np.inf, -np.inf])),
        *(np.zeros((k, 1)), ["soon"] * k, None, time_s, [10**400] * k, Hostile()),
    )
    return things[int(rng.integers(len(things)))]


def odd_sample(rng, sample):
    """A sample of which one part or all of it is odd."""
    time_s, twist, readings = sample.time_s, sample.twist, dict(sample.readings)
    for name, width in WIDTH.items():
        if rng.random() < 0.5:
            whole = Reading(odd_stamp(rng, time_s), odd_value(rng, width))
            readings[name] = (whole, odd_value(rng, width), (1, 2, 3))[int(rng.integers(3))]
    if rng.random() < 0.3:
        twist = odd_value(rng, 3)
    if rng.random() < 0.3:
        stamps = odd_stamp(rng, time_s)
        time_s = stamps[0] if isinstance(stamps, np.ndarray) and stamps.size else stamps
    if rng.random() < 0.05:
        readings = odd_value(rng, 3)
    whole = Sample(time_s, twist, readings, "grass" if rng.random() < 0.9 else odd_value(rng, 2))
    return whole if rng.random() < 0.98 else odd_value(rng, 3)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_2500_odd_samples_of_each_controller_neither_raise_nor_command_nonsense(controller, survey):
    rng, sound = np.random.default_rng(7), list(replay(survey))
    settings = PilotSettings(controller=controller, track=controller == "traction")
    pilot = LivePilot(ROBOT, settings=settings)
    with np.errstate(all="ignore"):
        for k in range(2500):
            sample = sound[k % len(sound)]
            command = pilot.step(odd_sample(rng, sample) if rng.random() < 0.7 else sample)
            assert tuple(command.status) == PilotStatus._fields
            for row in (command.wheel_radps, command.steer_rad, command.twist):
                assert row.shape == (3,)
                assert np.isfinite(row).all()
