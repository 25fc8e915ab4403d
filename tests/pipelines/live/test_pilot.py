"""The live chain: it never raises, reports its status, and improves the drive in the closed loop."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.drive.controllers import DriveInputs, drive_once
from pipelines.live.pilot import LivePilot
from terrain.control.controllers import make_controller
from terrain.control.drive_metrics import distance_within, drive_history, final_speed, slip_peak
from terrain.control.path_tracking import PoseEstimate, TrackStatus, initial_tracking, track_step
from terrain.control.pid import Gains
from terrain.control.pilot_settings import PilotSettings
from terrain.control.situations import SituationOptions, make_situation, start_times
from terrain.control.slip_table import load_slip_table
from terrain.control.terrain_source import KnownTerrain
from terrain.control.tracking_settings import SETTINGS as TRACKING
from terrain.control.tracking_settings import check_tracking
from terrain.control.traction import TractionStatus
from terrain.control.traction_settings import SETTINGS
from terrain.errors import ConfigError
from terrain.estimation.live.health import SENSORS, Health
from terrain.logs.replay import TWIST as TWIST_CHANNELS
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
DT_S, DELAY_S = 0.02, 0.05
NAN = math.nan


def pilot(controller="traction", **settings):
    return LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller, **settings))


@cache
def recorded():
    """Samples of a plain drive."""
    return list(replay(simulate_run(ROBOT, "grass", "straight", 7, duration_s=16.0)))


def everywhere(make):
    """The same reading of every sensor."""
    widths = {"wheels": 6, "steering": 3, "imu": 9, "odometry": 16}
    return {name: make(width) for name, width in widths.items()}


WRONG = {
    "nothing": {},
    "NaN": everywhere(lambda width: Reading(np.array([NAN]), np.full((1, width), NAN))),
    "too wide": everywhere(lambda width: Reading(np.array([8.0]), np.zeros((1, width + 3)))),
    "None": everywhere(lambda width: Reading(None, None)),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_without_readings_it_reports_so_and_fades_to_the_desired_speed(wrong):
    live, reference, twist = pilot(), pilot("plain"), np.array([0.6, 0.2, 0.1])
    for k in range(200):
        command = live.step(Sample(k * DT_S, twist, WRONG[wrong]))
        plain = reference.step(Sample(k * DT_S, twist, {}))
        assert k <= 100 or command.status["status_code"] != TractionStatus.OK
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
    again = live.step(sample._replace(time_s=sample.time_s + offset_s, readings={}))
    assert again.status["status_code"] == TractionStatus.BAD_TIME


@pytest.mark.parametrize(
    ("robot", "table", "settings", "message"),
    [
        ("agrimaro", {}, {"controller": "best"}, "controller 'best' is unknown: use one of plain, ramp"),
        ("husky", {}, {}, "robot husky: drive 'skid_steer' has no pilot, only 'swerve' has"),
        ("agrimaro", {"robot": "o"}, {}, "slip table default: is of the robot 'o', not of 'agrimaro'"),
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


# In the loop


@cache
def driven(name, scenario, terrain, seed, faults=None, **options):
    """A drive of that controller and its situation."""
    where = make_situation(scenario, ROBOT, terrain, seed, SituationOptions(**options))
    if faults is not None:
        where = where._replace(faults=faults)
    return drive_once(DriveInputs(ROBOT, TABLE), make_controller(name, TABLE, DELAY_S), where), where


@cache
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


def test_a_lost_camera_is_named_within_a_third_of_a_second_until_it_is_back():
    faults = Faults(((4.0, 9.0),))
    run, _ = driven("known:grass", "straight", "grass", 200, faults=faults, duration_s=14.0)
    control = run.streams["control"]
    time_s, why = control.time_s, control.channel("status_code")
    gone, lost = (time_s > 4.3) & (time_s < 9.0), (time_s > 4.0) & (time_s < 9.0)
    assert set(why[(time_s > 2.0) & (time_s < 4.1)]) == {TractionStatus.OK}
    assert set(why[gone]) == {TractionStatus.UNSOUND}
    assert set(why[time_s > 9.5]) == {TractionStatus.OK}
    assert {SENSORS[int(place)] for place in control.channel("sensor_code")[gone]} == {"camera_speed"}
    assert set(control.channel("health_code")[gone]) == {Health.LOST}
    assert control.channel("stale_s")[lost].max() == pytest.approx(5.0, abs=0.1)
    assert np.isnan(control.channel("slip_ratio")[time_s > 2.0]).sum() == 0
    assert np.ptp(control.channel("driven_mps")[gone]) < 0.01


def test_a_start_on_grass_slips_less_and_travels_nearly_as_far():
    plain, limited = (history(name, "starts", "grass", 200) for name in ("plain", "known:grass"))
    for start_s in start_times(make_situation("starts", ROBOT, "grass", 200).scenario)[1:]:
        within = (plain.time_s >= start_s) & (plain.time_s < start_s + 7)
        assert slip_peak(plain, within) > 1.5 * slip_peak(limited, within)
        assert distance_within(limited, start_s, 5.0) > 0.85 * distance_within(plain, start_s, 5.0)


def test_wheels_of_unequal_radius_do_not_work_against_each_other_in_a_circle_on_tiles():
    factors = (1.02, 1.0, 1.0)
    plain, limited = (
        history(name, "circle", "tiles", 200, radius_factors=factors) for name in ("plain", "known:tiles")
    )
    after = np.searchsorted(plain.time_s, 6.0)
    for what, most in (("scrub_along_j", 0.2), ("energy_j", 0.6)):
        spent, spent_limited = (getattr(c, what)[-1] - getattr(c, what)[after] for c in (plain, limited))
        assert spent_limited < most * spent
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


def test_backward_and_sideways_slip_is_estimated_and_limited_as_forward():
    run, _ = driven("known:grass", "complex", "grass", 202)
    control, truth = run.streams["control"], history("known:grass", "complex", "grass", 202)
    at = np.searchsorted(truth.time_s, control.time_s - 0.02)  # the estimate is that old
    true = np.nan_to_num(truth.slip_ratio[at], nan=-1.0).max(axis=1)
    fast = (np.abs(truth.ground_mps[at]) > 0.25).all(axis=1) & (control.time_s > 1.0)
    error = control.channel("slip_ratio")[fast] - true[fast]
    assert fast.sum() > 500
    assert np.sqrt(np.mean(error**2)) < 0.05
    why = control.channel("status_code")[control.time_s > 1.0]
    assert (why == TractionStatus.UNSOUND).mean() < 0.01  # a dropout of the camera
    assert set(why) <= {TractionStatus.OK, TractionStatus.UNCERTAIN, TractionStatus.UNSOUND}
    assert slip_peak(truth) < slip_peak(history("plain", "complex", "grass", 202))


def off_the_path(scenario, terrain, seed, duration_s):
    """Return the distance from the path at each step with a good status, and how many steps have one.

    The path is that of the tracking itself, fed with the true motion: it starts anew at each standstill, and
    the robot is on it wherever along it slip has let it come.
    """
    run, situation = driven("fallback+track", scenario, terrain, seed, duration_s=duration_s)
    truth, control = run.streams["truth"], run.streams["control"]
    time_s = control.time_s

    def at(source_s, columns):
        return np.column_stack([np.interp(time_s, source_s, column) for column in columns])

    pose = at(truth.time_s, [truth.channel(name) for name in ("position_x_m", "position_y_m", "yaw_rad")])
    ground = at(truth.time_s, [truth.channel(name) for name in TWIST_CHANNELS])
    desired = at(situation.scenario.time_s, situation.scenario.twist.T)
    settings, state, off_m = check_tracking(ROBOT, TRACKING, DELAY_S), initial_tracking(), []
    for place, twist, motion in zip(pose, desired, ground, strict=True):
        seen = PoseEstimate(*map(float, place), yaw_std_rad=0.0, stale_s=0.0)
        _, state, report = track_step(settings, state, twist.copy(), seen, motion.copy(), 0.02)
        off_m.append(abs(report.cross_track_m))
    tracked = np.isin(control.channel("track_status_code"), (TrackStatus.OK, TrackStatus.CLAMPED))
    good = tracked & (control.channel("status_code") == TractionStatus.OK)
    return np.array(off_m)[good], good


def test_a_minute_on_the_path():
    off_m, good = off_the_path("complex", "tiles", 63, 60.0)
    assert np.nanmax(off_m) < 0.3
    assert good.mean() > 0.5  # the others stand


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["straight", "complex"])
@pytest.mark.parametrize("terrain", ["tiles", "grass", "dry_sand"])
def test_ten_minutes_on_the_path(scenario, terrain):
    off_m, good = off_the_path(scenario, terrain, 64, 600.0)
    assert np.nanmax(off_m) < 0.3
    assert good.mean() > 0.8
