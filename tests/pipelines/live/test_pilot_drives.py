"""The pilot of every drive in the closed loop with its live estimator and the simulated robot."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipelines.live.chain import CommandStatus
from pipelines.live.pilot import LivePilot
from terrain.control.drive_metrics import distance_within, drive_history, slip_peak
from terrain.control.learned_table import simulated_table
from terrain.control.robot_control import PilotSettings
from terrain.control.situations import SituationOptions, make_situation, simulate_situation, start_times
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import KnownTerrain
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Reading, Sample
from terrain.robots import SkidSteerRobot, load_robot
from terrain.simulation.assumed import with_assumed
from terrain.simulation.scenario import RATE_HZ

TABLE, DELAY_S = load_slip_table(), 0.05
DRIVES = {
    "husky": "grass",
    "marmotte": "grass",
    "robotino": "tiles",
    "omnirobot": "tiles",
    "adap2e": "grass",
    "pallet_truck": "asphalt",
}
ROBOTS = {name: with_assumed(load_robot(name)) for name in DRIVES}
ROBOTS["mine"] = with_assumed(SkidSteerRobot("mine", 0.165, 0.57, 0.512, 50.0))
every_drive = pytest.mark.parametrize("name", ROBOTS)


def driven(
    name, controller, twist=(0.4, 0.0, 0.0), length_s=6.0, terrain=None, scenario="straight", seed=210
):
    """The situation and the log of a drive; of a constant twist after half a second, or of the scenario's own."""
    robot, terrain = ROBOTS[name], terrain or DRIVES.get(name, "grass")
    made = make_situation(scenario, robot, terrain, seed, SituationOptions(speed_mps=0.4 if twist else 1.0))
    if twist:
        time_s = np.arange(round(length_s * RATE_HZ) + 1) / RATE_HZ
        desired = np.clip(2.0 * (time_s - 0.5), 0.0, 1.0)[:, None] * np.array(twist)
        scenario_of = type(made.scenario)
        drive = scenario_of("drive", RATE_HZ, time_s, desired, made.scenario.patches)
        made = made._replace(scenario=drive)
    pilot = LivePilot(robot, TABLE, KnownTerrain(), PilotSettings(controller=controller))
    return made, simulate_situation(robot, made, pilot.step, DELAY_S), pilot


@every_drive
def test_a_pilot_drives_as_far_as_plain_commands_and_knows_its_slip(name):
    runs = {kind: driven(name, kind) for kind in ("plain", "traction")}
    travelled = {}
    for kind, (made, log, _) in runs.items():
        history = drive_history(log, ROBOTS[name], made.conditions.radius_factors)
        travelled[kind] = float(history.distance_m[-1])
        assert np.isfinite(log.streams["commands"].values).all()
    assert travelled["traction"] > 0.8 * travelled["plain"]
    control = runs["traction"][1].streams["control"]
    late = control.time_s > 3.0
    assert (control.channel("status_code")[late] == 0.0).mean() > 0.9
    assert runs["traction"][2].estimate.reference_age_s < 1.0


@pytest.mark.parametrize("name", ["husky", "marmotte", "mine"])
def test_the_turn_of_a_robot_that_skids_is_kept_within_a_twentieth(name):
    (_, plain, _), (_, kept, pilot) = (
        driven(name, kind, (0.4, 0.0, 0.3), 10.0, "asphalt") for kind in ("plain", "traction")
    )
    rates = []
    for log in (plain, kept):
        truth = log.streams["truth"]
        late = truth.time_s > 6.0
        rates.append(float(truth.channel("yaw_rate_radps")[late].mean()))
    assert rates[0] < 0.8 * 0.3
    assert rates[1] == pytest.approx(0.3, rel=0.05)
    assert pilot.control._turn.track_ratio > 1.2


def test_a_start_of_a_skid_steer_robot_on_grass_slips_less_and_travels_nearly_as_far():
    found = []
    for kind in ("plain", "traction"):
        made, log, _ = driven("husky", kind, twist=None, scenario="starts")
        history = drive_history(log, ROBOTS["husky"], made.conditions.radius_factors)
        start_s = start_times(made.scenario)[1]
        within = (history.time_s >= start_s) & (history.time_s < start_s + 7.0)
        found.append((slip_peak(history, within), distance_within(history, start_s, 5.0)))
    (plain_peak, plain_m), (peak, travelled_m) = found
    assert peak < plain_peak * 2.0 / 3.0
    assert travelled_m > 0.88 * plain_m


@every_drive
def test_whatever_arrives_a_command_of_the_right_shape_is_given(name):
    robot, rng = ROBOTS[name], np.random.default_rng(0)
    channels = sensor_channels(robot)
    pilot = LivePilot(robot, TABLE, channels=channels)
    n = len(robot.wheels)
    for k in range(120):
        readings = {
            stream: Reading(np.array([0.02 * k]), rng.normal(size=(1, len(names))))
            for stream, names in channels.items()
            if rng.random() < 0.8
        }
        if k % 7 == 0:
            readings["wheels"] = Reading(None, None)
        if k % 11 == 0:
            readings["imu"] = Reading(np.array([math.nan]), np.full((1, 3), math.inf))
        step = pilot.take(Sample(0.02 * k, rng.normal(size=3), readings))
        assert step.status in (CommandStatus.OK, CommandStatus.NOT_FINITE)
        assert step.command.wheel_radps.shape == step.command.steer_rad.shape == (n,)
        assert all(np.isfinite(row).all() for row in step.command[:3])


def test_targets_of_a_skid_steer_robot_are_learned_from_simulated_runs():
    table = simulated_table(ROBOTS["husky"], ["grass"], 5000, lambda done, total: None)
    targets = table.lookup("grass")
    assert 0.03 < targets["steady"].slip_ratio < 0.3
    assert targets["traction"].slip_ratio > targets["steady"].slip_ratio
    assert table.robot == "husky"
