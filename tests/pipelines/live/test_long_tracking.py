"""Path tracking over ten minutes: distance from the path by the true pose, while the status is good."""

import numpy as np
import pytest

from pipelines.drive.controllers import DriveInputs, drive_once
from terrain.control.controllers import make_controller
from terrain.control.path_tracking import PoseEstimate, TrackStatus, initial_tracking, track_step
from terrain.control.situations import SituationOptions, make_situation
from terrain.control.slip_table import load_slip_table
from terrain.control.tracking_settings import SETTINGS, check_tracking
from terrain.control.traction import TractionStatus
from terrain.robots import load_robot

ROBOT, TABLE, DELAY_S = load_robot("agrimaro"), load_slip_table(), 0.05
TWIST = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")


def off_the_path(scenario, terrain, seed, duration_s):
    """Return the distance from the path at each step with a good status, and how many steps have one.

    The path is that of the tracking itself, fed with the true motion: it starts anew at each standstill, and
    the robot is on it wherever along it slip has let it come.
    """
    situation = make_situation(scenario, ROBOT, terrain, seed, SituationOptions(duration_s=duration_s))
    run = drive_once(DriveInputs(ROBOT, TABLE), make_controller("fallback+track", TABLE, DELAY_S), situation)
    truth, control = run.streams["truth"], run.streams["control"]
    time_s = control.time_s

    def at(source_s, columns):
        return np.column_stack([np.interp(time_s, source_s, column) for column in columns])

    pose = at(truth.time_s, [truth.channel(name) for name in ("position_x_m", "position_y_m", "yaw_rad")])
    ground = at(truth.time_s, [truth.channel(name) for name in TWIST])
    desired = at(situation.scenario.time_s, situation.scenario.twist.T)
    settings, state, off_m = check_tracking(ROBOT, SETTINGS, DELAY_S), initial_tracking(), []
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
