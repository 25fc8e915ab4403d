"""The live chain: it never raises, reports its status, and improves the drive in the closed loop."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.drive.controllers import DriveInputs, drive_once
from pipelines.live.pilot import LivePilot
from pipelines.live.terrain_source import KnownTerrain
from terrain.control.controllers import make_controller
from terrain.control.drive_metrics import distance_within, drive_history, final_speed, slip_peak
from terrain.control.pid import Gains
from terrain.control.pilot_settings import PilotSettings
from terrain.control.situations import SituationOptions, make_situation, start_times
from terrain.control.slip_table import CurveEntry, load_slip_table
from terrain.control.traction import TractionStatus
from terrain.control.traction_settings import SETTINGS
from terrain.errors import ConfigError
from terrain.estimation.live.health import SENSORS, Health
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.slip_learning.laws import LAW_PARAMETERS

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
DT_S, DELAY_S = 0.02, 0.05
NAN = math.nan
SEEDS = (200, 201)
CORRECTING = ("thesis", "traction")


def pilot(controller="traction", **settings):
    return LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller, **settings))


@cache
def recorded(scenario="straight", duration_s=16.0, terrain="grass"):
    """Samples of a plain drive."""
    return list(replay(simulate_run(ROBOT, terrain, scenario, 7, duration_s=duration_s)))


def everywhere(make):
    """The same reading of every sensor."""
    return {
        name: make(width) for name, width in (("wheels", 6), ("steering", 3), ("imu", 9), ("odometry", 16))
    }


WRONG = {
    "nothing": {},
    "NaN": everywhere(lambda width: Reading(np.array([NAN]), np.full((1, width), NAN))),
    "too wide": everywhere(lambda width: Reading(np.array([8.0]), np.zeros((1, width + 3)))),
    "None": everywhere(lambda width: Reading(None, None)),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_without_readings_it_reports_so_and_fades_to_the_desired_speed(wrong):
    live, twist = pilot(), np.array([0.6, 0.2, 0.1])
    for k in range(200):
        command = live.step(Sample(k * DT_S, twist, WRONG[wrong]))
        if k > 100:
            assert command.status["status_code"] != TractionStatus.OK
    reference = LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="plain"))
    for k in range(200):
        plain = reference.step(Sample(k * DT_S, twist, {}))
    assert command.wheel_radps == pytest.approx(plain.wheel_radps)
    assert np.array_equal(command.steer_rad, plain.steer_rad)
    assert command.twist == pytest.approx(plain.twist)


@pytest.mark.parametrize("time_s", [NAN, 7.0, 8.6, 1e6, math.inf])
def test_a_wrong_clock_causes_no_jump_and_no_end_of_slip_control(time_s):
    """The clock of the steps is set once, for good or for a step; that of the streams is not."""
    live, offset_s = pilot(), 0.0
    for sample in recorded():
        if sample.time_s > 8.0 and offset_s == 0.0:
            before = live.step(sample._replace(time_s=time_s, twist=np.array([1.0, 0.0, 0.0])))
            offset_s = time_s - sample.time_s if math.isfinite(time_s) else 1e-6
            continue
        command = live.step(sample._replace(time_s=sample.time_s + offset_s))
        if 8.0 < sample.time_s < 8.3:
            rise = command.wheel_radps - before.wheel_radps
            assert (rise * ROBOT.wheel_radius_m <= SETTINGS.fade_mps2 * DT_S + 0.05).all()
            before = command
        if 8.3 < sample.time_s < 12.0:
            assert command.status["status_code"] == TractionStatus.OK


def test_a_step_at_the_same_time_is_reported():
    live = pilot()
    for sample in recorded()[:300]:
        live.step(sample)
    assert live.step(sample._replace(readings={})).status["status_code"] == TractionStatus.BAD_TIME


def test_it_needs_neither_tracking_nor_a_web_server():
    program = (
        "import sys, pipelines.live.pilot\n"
        "heavy = {'mlflow', 'fastapi', 'uvicorn', 'torch', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(' '.join(sorted(heavy)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(
    ("robot", "table", "settings", "message"),
    [
        ("agrimaro", {}, {"controller": "best"}, "controller 'best' is unknown: use one of plain, ramp"),
        ("husky", {}, {}, "robot husky: drive 'skid_steer' has no pilot, only 'swerve' has"),
        (
            "agrimaro",
            {"robot": "other"},
            {},
            "slip table default: is of the robot 'other', not of 'agrimaro'",
        ),
        ("agrimaro", {}, {"controller": "ramp", "ramp_mps2": 0.0}, "ramp_mps2 is 0.0"),
        ("agrimaro", {}, {"traction": SETTINGS._replace(lead_s=-1)}, "traction: lead_s is -1"),
        ("agrimaro", {}, {"controller": "thesis", "gains": Gains(3.0, 0.0, 0.0, 2.0)}, ""),
        ("agrimaro", {}, {"controller": "thesis", "gains": Gains(-1.0, 0.0, 0.0, 2.0)}, "gain kp is -1.0"),
    ],
)
def test_invalid_settings_are_refused_in_one_sentence(robot, table, settings, message):
    with pytest.raises(ConfigError) as refused:
        LivePilot(load_robot(robot), replace(TABLE, **table), settings=PilotSettings(**settings))
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)


def test_a_known_terrain_moves_the_target_at_its_rate():
    live = LivePilot(ROBOT, TABLE, KnownTerrain())
    targets, names = [], []
    for k in range(200):
        command = live.step(Sample(k * DT_S, np.zeros(3), {}, "grass" if k < 20 else "tiles"))
        targets.append(command.status["target_ratio"])
        names.append(live.terrains[int(command.status["terrain_code"])])
    assert names == ["grass"] * 20 + ["tiles"] * 180
    assert targets[0] == TABLE.lookup("grass")["traction"].slip_ratio
    assert targets[-1] == TABLE.lookup("tiles")["traction"].slip_ratio
    assert np.abs(np.diff(targets)).max() == pytest.approx(0.1 * DT_S)


# In the loop


@cache
def driven(name, scenario, terrain, seed, faults=None, **options):
    """A drive of that controller and its situation."""
    where = make_situation(scenario, ROBOT, terrain, seed, SituationOptions(**options))
    if faults is not None:
        where = where._replace(faults=faults)
    return drive_once(DriveInputs(ROBOT, TABLE), make_controller(name, TABLE, DELAY_S), where), where


def history(name, scenario, terrain, seed, **options):
    run, where = driven(name, scenario, terrain, seed, **options)
    return drive_history(run, ROBOT, where.conditions.radius_factors)


def test_without_slip_it_drives_the_plain_command():
    """On asphalt, sped up by no more than it can follow."""
    run, _ = driven("known:asphalt", "straight", "asphalt", 200, duration_s=12.0, accel_mps2=0.5)
    control = run.streams["control"]
    short = control.channel("desired_mps") - control.channel("driven_mps")
    assert (short >= 0).all()
    assert short.max() < 0.15
    assert short[control.time_s > 4.0].max() == 0.0
    wheels = np.column_stack([run.streams["commands"].channel(f"wheel_{i}_radps") for i in (1, 2, 3)])
    assert wheels[-1] == pytest.approx(np.full(3, 5.0), rel=0.02)


@pytest.mark.parametrize("lost_s", [(4.0, 5.0), (4.0, 9.0)])
def test_a_lost_camera_is_named_within_a_third_of_a_second(lost_s):
    run, _ = driven("known:grass", "straight", "grass", 200, faults=Faults((lost_s,)), duration_s=14.0)
    control = run.streams["control"]
    time_s, why = control.time_s, control.channel("status_code")
    assert set(why[(time_s > 2.0) & (time_s < 4.1)]) == {TractionStatus.OK}
    gone = (time_s > 4.3) & (time_s < lost_s[1])
    assert set(why[gone]) == {TractionStatus.UNSOUND}
    named = {SENSORS[int(place)] for place in control.channel("sensor_code")[gone]}
    assert named == {"camera_speed"}
    assert set(control.channel("health_code")[gone]) == {Health.LOST}
    assert set(why[time_s > lost_s[1] + 0.5]) == {TractionStatus.OK}
    lost = (time_s > lost_s[0]) & (time_s < lost_s[1])
    assert control.channel("stale_s")[lost].max() == pytest.approx(lost_s[1] - lost_s[0], abs=0.1)
    assert np.isnan(control.channel("slip_ratio")[time_s > 2.0]).sum() == 0
    assert np.ptp(control.channel("driven_mps")[gone]) < 0.01


@pytest.mark.parametrize("seed", SEEDS)
def test_a_start_on_grass_slips_less_and_travels_nearly_as_far(seed):
    plain, limited = (history(name, "starts", "grass", seed) for name in ("plain", "known:grass"))
    starts = start_times(make_situation("starts", ROBOT, "grass", seed).scenario)
    for start_s in starts[1:]:
        within = (plain.time_s >= start_s) & (plain.time_s < start_s + 7)
        assert slip_peak(plain, within) > 1.5 * slip_peak(limited, within)
        assert distance_within(limited, start_s, 5.0) > 0.85 * distance_within(plain, start_s, 5.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_wheels_of_unequal_radius_do_not_work_against_each_other_in_a_circle_on_tiles(seed):
    plain, limited = (
        history(name, "circle", "tiles", seed, radius_factors=(1.02, 1.0, 1.0))
        for name in ("plain", "known:tiles")
    )
    after = np.searchsorted(plain.time_s, 6.0)
    scrub, energy = (
        [(getattr(c, what)[-1] - getattr(c, what)[after]) for c in (plain, limited)]
        for what in ("scrub_along_j", "energy_j")
    )
    assert scrub[1] < 0.2 * scrub[0]
    assert energy[1] < 0.6 * energy[0]
    assert limited.distance_m[-1] == pytest.approx(plain.distance_m[-1], rel=0.02)


@pytest.mark.parametrize("target", [0.02, 0.6])
def test_a_wrong_target_costs_no_speed_on_dry_sand(target):
    options = {"scenario": "straight", "terrain": "dry_sand", "seed": 200, "duration_s": 40.0}
    plain, limited = (final_speed(history(name, **options)) for name in ("plain", f"target:{target}"))
    assert limited == pytest.approx(plain, rel=0.005)


@pytest.mark.slow
def test_the_thesis_slows_below_the_balance_and_the_traction_controller_does_not():
    """On grass, whose balance is near 0.126, with 0.05 as the target of steady motion."""
    options = {"scenario": "straight", "terrain": "grass", "seed": 201, "duration_s": 40.0}
    assert TABLE.lookup("unknown")["steady"].slip_ratio == 0.05
    plain, thesis, limited = (
        final_speed(history(name, **options)) for name in ("plain", "thesis", "target:0.05")
    )
    assert thesis < 0.8 * plain
    assert limited == pytest.approx(plain, rel=0.005)


@pytest.mark.parametrize("scenario", [pytest.param("crab", marks=pytest.mark.slow), "complex"])
def test_backward_and_sideways_slip_is_estimated_and_limited_as_forward(scenario):
    run, where = driven("known:grass", scenario, "grass", 202)
    control = run.streams["control"]
    truth = drive_history(run, ROBOT, where.conditions.radius_factors)
    at = np.searchsorted(truth.time_s, control.time_s - 0.02)  # the estimate is that old
    true = np.nan_to_num(truth.slip_ratio[at], nan=-1.0).max(axis=1)
    fast = (np.abs(truth.ground_mps[at]) > 0.25).all(axis=1) & (control.time_s > 1.0)
    error = control.channel("slip_ratio")[fast] - true[fast]
    assert fast.sum() > 500
    assert np.sqrt(np.mean(error**2)) < 0.05
    why = control.channel("status_code")[control.time_s > 1.0]
    assert (why == TractionStatus.UNSOUND).mean() < 0.01  # a dropout of the camera
    assert set(why) <= {TractionStatus.OK, TractionStatus.UNCERTAIN, TractionStatus.UNSOUND}
    plain = history(
        "plain",
        scenario,
        "grass",
        202,
    )
    assert slip_peak(truth) < slip_peak(plain)


def slick_table():
    """A table whose snow has a curve that falls by a fifth beyond its peak."""
    named = dict(zip(LAW_PARAMETERS["magic"], (25.0, 1.5, 0.3, 0.0), strict=True))
    numbers = (0.07, (0.05, 0.1), "peak", (0.0, 0.8), 0.02, 0.01, 0.01, 0.07, None, 0.9, 1.0, 1.0, 1.0)
    return replace(TABLE, curves={"snow": CurveEntry("magic", named, *numbers, 5)})


@pytest.mark.parametrize(
    ("direction", "tilt_rad", "uphill"),
    [
        ((1.0, 0.0), (0.0, -0.1), 1),
        ((-1.0, 0.0), (0.0, -0.1), -1),
        ((0.0, 1.0), (0.1, 0.0), 1),
        ((0.0, -1.0), (0.1, 0.0), -1),
    ],
)
def test_the_expected_deceleration_is_larger_uphill_in_any_direction(direction, tilt_rad, uphill):
    live = LivePilot(ROBOT, slick_table(), KnownTerrain())
    live.step(Sample(0.0, np.zeros(3), {}, "snow"))
    wheels = Reading(np.array([0.0]), np.zeros((1, 6)))
    imu = Reading(np.array([0.0]), np.array([[0.0] * 3 + [0.0, 0.0, 9.81] + [*tilt_rad, 0.0]]))
    live.step(Sample(0.02, np.zeros(3), {"wheels": wheels, "imu": imu}, "snow"))
    live.estimate = live.estimate._replace(speed_x_mps=direction[0], speed_y_mps=direction[1])
    level = live._aims["snow"].braking.mps2
    found = live._target(0.02)
    assert found.braking_mps2 - level == pytest.approx(uphill * 9.81 * math.sin(0.1), rel=0.01)
    assert live._target(0.02).braking_ratio == live._aims["snow"].braking.slip_ratio


def judged(**statuses):
    """Return the sensor that a pilot names, and its status, where the estimator has found some statuses."""
    live = pilot()
    for sample in recorded()[:50]:
        live.step(sample)
    health = np.zeros(len(SENSORS), np.int8)
    for name, status in statuses.items():
        health[SENSORS.index(name)] = status
    live.estimate = live.estimate._replace(health=health)
    place, status = live._judge()
    return (SENSORS[place] if place >= 0 else None), Health(status)


def test_the_sensor_is_named_that_takes_others_with_it():
    assert judged() == (None, Health.FRESH)
    assert judged(gyro=Health.LATE) == (None, Health.LATE)
    assert judged(wheel_1=Health.LOST, camera_speed=Health.FROZEN) == ("camera_speed", Health.FROZEN)
    assert judged(wheel_1=Health.STEPPED, camera_speed=Health.LOST) == ("wheel_1", Health.STEPPED)
    assert judged(wheel_1=Health.GATED, camera_speed=Health.LOST) == ("camera_speed", Health.LOST)


def test_a_wheel_that_does_not_follow_its_command_disagrees_and_is_not_called_lost():
    live = pilot()
    for sample in recorded():
        readings = dict(sample.readings)
        if "wheels" in readings and sample.time_s > 6.0:
            values = readings["wheels"].values.copy()
            values[:, 1] *= 0.5
            readings["wheels"] = Reading(readings["wheels"].time_s, values)
        live.step(sample._replace(readings=readings))
    assert live.health["wheel_2"] == "disagrees"
    assert live.estimate.health[SENSORS.index("wheel_2")] == Health.LOST
