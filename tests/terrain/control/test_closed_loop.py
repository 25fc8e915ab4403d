"""A robot's control in the closed loop with its estimator and a simulated robot: what it gains, and that it stays."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrain.control.controllers import make_controller
from terrain.control.drive_metrics import distance_within, drive_history, final_speed, slip_peak
from terrain.control.robot_control import OPEN_LOOP, RobotControl
from terrain.control.situations import SituationOptions, make_situation, simulate_situation, start_times
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import OutputStatus, TerrainBelief
from terrain.estimation.live import CHANNELS, make_live_filter
from terrain.robots import load_robot
from terrain.simulation.scenario import Faults

ROBOT, TABLE, DELAY_S = load_robot("agrimaro"), load_slip_table(), 0.05


class Loop:
    """A controller by name with its estimator, with a known terrain or none."""

    def __init__(self, name):
        controller = make_controller(name, TABLE, DELAY_S)
        self.filter = (
            None if controller.pilot.controller in OPEN_LOOP else make_live_filter("vio15", ROBOT, CHANNELS)
        )
        states = () if self.filter is None else self.filter.states
        self.control = RobotControl(ROBOT, controller.table, controller.pilot, states)
        self.belief, self.seen, self.time_s = TerrainBelief(controller.known_terrain, 1.0), None, math.nan

    def step(self, sample):
        time_s, dt_s, readings = sample.time_s, sample.time_s - self.time_s, dict(sample.readings)
        self.time_s = time_s
        if self.filter is not None:
            self.control.measured(time_s, dt_s, readings, self.seen)
            self.filter.step(readings, time_s)
            self.seen = self.filter.at(time_s)
        now = time_s, dt_s if math.isfinite(dt_s) else 0.02, sample.twist, self.seen
        return self.control.step(*now, self.belief, OutputStatus.NONE, holds=True)[0]


def history(name, scenario, terrain, seed, until_s=math.inf, **options):
    """The history of a drive of that controller, up to a time."""
    where = make_situation(scenario, ROBOT, terrain, seed, SituationOptions(**options))
    within = where.scenario.time_s <= until_s
    time_s, twist = where.scenario.time_s[within], where.scenario.twist[within]
    where = where._replace(scenario=replace(where.scenario, time_s=time_s, twist=twist))
    run = simulate_situation(ROBOT, where, Loop(name).step, DELAY_S)
    return drive_history(run, ROBOT, where.conditions.radius_factors)


def test_a_start_on_grass_slips_less_and_travels_nearly_as_far():
    """The second, of which the slip of steady motion is known."""
    start_s = start_times(make_situation("starts", ROBOT, "grass", 200).scenario)[1]
    plain, limited = (
        history(name, "starts", "grass", 200, until_s=start_s + 7.0) for name in ("plain", "known:grass")
    )
    within = plain.time_s >= start_s
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


def test_a_wrong_target_costs_no_speed_on_dry_sand():
    options = {"scenario": "straight", "terrain": "dry_sand", "seed": 200, "duration_s": 15.0}
    plain, low, high = (
        final_speed(history(name, **options)) for name in ("plain", "target:0.02", "target:0.6")
    )
    assert [low, high] == pytest.approx([plain, plain], rel=0.005)


def test_tracking_holds_on_a_side_slope_with_backlash_and_without_a_camera():
    ends, options = {}, SituationOptions(duration_s=16.0, leg_backlash_rad=0.02)
    where = make_situation("straight", ROBOT, "grass", 200, options)
    slope = replace(where.conditions, grade_ratio=(0.0, math.tan(math.radians(5.0))))
    where = where._replace(conditions=slope, faults=Faults(camera_lost_s=((8.0, 11.0),)))
    for name in ("plain", "fallback+track"):
        truth = simulate_situation(ROBOT, where, Loop(name).step, DELAY_S).streams["truth"]
        moved = [abs(np.ptp(truth.channel(each)[[0, -1]])) for each in ("position_y_m", "yaw_rad")]
        ends[name] = np.array(moved)
    assert ends["plain"][0] > 1.0
    assert (ends["fallback+track"] < [0.1 * ends["plain"][0], 0.3 * ends["plain"][1]]).all()
