"""The live chain: it never raises, reports its status, and improves the drive in the closed loop."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from pipelines.live.pilot import LivePilot
from terrain.control.pid import Gains
from terrain.control.pilot_settings import PilotSettings
from terrain.control.situations import SituationOptions, make_situation, simulate_situation
from terrain.control.slip_table import load_slip_table
from terrain.control.terrain_source import KnownTerrain
from terrain.control.traction import TractionStatus
from terrain.control.traction_settings import SETTINGS
from terrain.errors import ConfigError
from terrain.estimation.live.health import SENSORS, Health
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run

ROBOT, TABLE = load_robot("agrimaro"), load_slip_table()
DT_S = 0.02
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


def test_a_lost_camera_is_named_within_a_third_of_a_second_until_it_is_back():
    faults = Faults(((4.0, 9.0),))
    where = make_situation("straight", ROBOT, "grass", 200, SituationOptions(duration_s=14.0))
    live = LivePilot(ROBOT, TABLE, KnownTerrain())
    run = simulate_situation(ROBOT, where._replace(faults=faults), live.step, 0.05)
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
