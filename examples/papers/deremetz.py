"""Deremetz et al., ICRA 2017: its experiments on simulated drives; its claims are in deremetz.yaml."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from car_scenarios import GRIP_RATIO, STOP, Course, slope_course, stop_course
from claims import Finding, Numbers, Trial
from multi_model import Gains, MultiModel

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points
from terrain.control.car_following import CarFollower, FollowedDrive, SlipSource, followed_drive
from terrain.estimation.models.observer import Observer
from terrain.estimation.models.sideslip import C_LOW_NPR, SETTINGS, Sideslip
from terrain.records import Array
from terrain.robots import BicycleRobot, as_drive, load_robot
from terrain.simulation.run import simulate

RUNS, FEW_RUNS = 5, 2
"""Drives that a figure is a mean of, and the number with ``quick``."""
FASTEST_MPS, FAST_MPS, MEDIUM_MPS, STOP_MPS = 6.0, 5.0, 4.0, 3.0
"""Speeds of the trials of sections VI.B and VI.A."""
SOFT_FRONT_NPR, SOFT_REAR_NPR = 8000.0, 10000.0
"""Tyres that are softer than the observers assume at first."""
SLOW_MPS = 0.5
BOUND_RATIO = 0.2
ASSUMED = (
    "Radii of 10 m, the grip of 0.7 and the bend turning uphill are assumed: the paper prints none of them."
)
WHEELS = ("front", "rear")


class Variant(NamedTuple):
    """A controller of the comparison: where its slip is from, and what is other about its observer."""

    source: SlipSource
    observer: Callable[[BicycleRobot], Observer] | None = None


VARIANTS: dict[str, Variant] = {
    "no observer": Variant(SlipSource.NONE),
    "dynamic": Variant(SlipSource.DYNAMIC),
    "kinematic": Variant(SlipSource.KINEMATIC),
    "multi-model": Variant(SlipSource.MULTI),
    "multi-model, gains of section VI": Variant(SlipSource.MULTI, MultiModel),
    "multi-model, printed signs": Variant(
        SlipSource.MULTI, lambda robot: MultiModel(robot, Gains(as_printed=True))
    ),
    "multi-model with preview": Variant(SlipSource.GRIP),
    "dynamic at every speed": Variant(
        SlipSource.DYNAMIC,
        lambda robot: Sideslip(
            robot, "sideslip-dynamic", SETTINGS["sideslip-dynamic"]._replace(slowest_mps=1e-3)
        ),
    ),
}
"""Controllers by name."""

Drives = Mapping[str, FollowedDrive]


def adap2e() -> BicycleRobot:
    """Return the robot of the paper."""
    return as_drive(BicycleRobot, load_robot("adap2e"), "robot {name}: a car-like one is needed")


def course_of(name: str) -> Course:
    """Return the course of a name."""
    return stop_course() if name == "stop" else slope_course()[0]


@lru_cache(maxsize=64)
def follow(course: str, speed_mps: float, variant: str, seed: int, soft: bool = False) -> FollowedDrive:
    """Return a drive along the course ``stop`` or ``slope``, on tyres as described or on softer ones."""
    robot, chosen, along = adap2e(), VARIANTS[variant], course_of(course)
    observer = None if chosen.observer is None else chosen.observer(robot)
    follower = CarFollower(robot, along.path, chosen.source, observer=observer)
    drive = along.drive(speed_mps, STOP if course == "stop" else ())
    driven = robot
    if soft:
        driven = replace(robot, front_cornering_npr=SOFT_FRONT_NPR, rear_cornering_npr=SOFT_REAR_NPR)
    run = simulate(driven, drive, along.ground, seed, run_id="car", controller=follower)
    return followed_drive(run, along.path, follower.ticks)


def drives(
    trial: Trial, speed_mps: float, variant: str, course: str = "slope", soft: bool = False
) -> list[FollowedDrive]:
    """Return drives that differ in their noise."""
    numbers = range(FEW_RUNS if trial.quick else RUNS)
    return [follow(course, speed_mps, variant, 1000 * trial.seed + k, soft) for k in numbers]


def over(
    found: Sequence[FollowedDrive],
    value: Callable[[FollowedDrive], float],
    beside: Mapping[str, float] | None = None,
    **values: Any,
) -> Numbers:
    """Return a number over drives."""
    return Numbers.over([value(drive) for drive in found], beside, **values)


def largest_lateral_m(drive: FollowedDrive) -> float:
    """Return the largest lateral error of a drive."""
    return drive.lateral_max_m()


def median_error(drive: FollowedDrive) -> float:
    """Return the median magnitude of the errors of the stiffness in a drive."""
    return float(np.median(np.abs(drive.stiffness_error_ratio)))


def stop(trial: Trial) -> Finding:
    """Compare the multi-model observer with a dynamic one that is not switched off near rest."""
    multi = drives(trial, STOP_MPS, "multi-model", "stop")
    dynamic = drives(trial, STOP_MPS, "dynamic at every speed", "stop")
    guarded = over(drives(trial, STOP_MPS, "dynamic", "stop"), largest_near_rest_deg).simulated
    where_m = STOP[0][0]
    before = over(multi, lambda drive: drive.lateral_max_m(0.0, where_m)).simulated
    known = all(np.isfinite(drive.slip_rad[1:]).all() for drive in multi)
    numbers = {
        "bounded": over(
            multi, lambda drive: float(np.degrees(np.nanmax(np.abs(drive.slip_rad[1:])))), known=known
        ),
        "dynamic": over(
            dynamic, largest_near_rest_deg, {"switched off below 0.3 m/s": guarded}, guarded=guarded
        ),
        "after": over(
            multi, lambda drive: drive.lateral_max_m(where_m), {"before the stop": before}, before=before
        ),
    }
    figures = {
        "map": map_figure({"multi-model": multi[0]}, "stop", "3 m/s with a stop in the middle"),
        "multi": sideslip_figure(multi[0], "Sideslip with a stop, multi-model observer"),
        "dynamic": sideslip_figure(dynamic[0], "Sideslip with a stop, dynamic observer at every speed"),
    }
    return Finding(numbers, figures)


def largest_near_rest_deg(drive: FollowedDrive) -> float:
    """Return the largest estimate close to the stop at low speed."""
    near = drive.between(STOP[0][0] - 2.0, STOP[0][0] + 2.0) & (drive.speed_mps < SLOW_MPS)
    return float(np.degrees(np.nanmax(np.abs(drive.slip_rad[near]))))


def slopes(trial: Trial) -> Finding:
    """Follow the trajectory of Fig. 7: four controllers at 5 m/s, the proposed one at 4 and 6 m/s."""
    at_5, other_speeds, first = [], [], {}
    for claim in trial.each["at_5"]:
        found = drives(trial, FAST_MPS, claim["name"])
        first[claim["name"]] = found[0]
        beside = {
            case.name: float(np.mean([drive.lateral_max_m(case.start_m, case.end_m) for drive in found]))
            for case in slope_course()[1]
        }
        at_5.append(over(found, largest_lateral_m, beside, assumed=ASSUMED))
    for claim in trial.each["other_speeds"]:
        found = drives(trial, claim["speed"], "multi-model")
        reached = sum(drive.reached_end for drive in found)
        bound_m = claim["speed"] / 10
        other_speeds.append(over(found, largest_lateral_m, bound=bound_m, reached=reached, n=len(found)))
    figures = {
        "map": map_figure(first, "slope", "5 m/s: path and robots"),
        "lateral": lateral_figure(first, FAST_MPS / 10.0, "5 m/s: lateral errors"),
    }
    return Finding({"at_5": at_5, "other_speeds": other_speeds}, figures)


def stiffness(trial: Trial) -> Finding:
    """Compare the estimated stiffness with the secant -F/b of the simulated tyre, while excited."""
    error = []
    for claim in trial.each["error"]:
        found = drives(trial, claim["speed"], "multi-model")
        inside = [float(np.mean(np.abs(one.stiffness_error_ratio) < BOUND_RATIO)) for one in found]
        error.append(over(found, median_error, {"part of the time within 20 %": float(np.mean(inside))}))
    printed = drives(trial, FAST_MPS, "multi-model, gains of section VI")
    soft = {
        name: drives(trial, MEDIUM_MPS, name, soft=True)
        for name in ("multi-model", "no observer", "multi-model with preview")
    }
    largest = {name: over(found, largest_lateral_m) for name, found in soft.items()}
    numbers = {
        "error": error,
        "printed_gains": over(
            printed, median_error, {"largest lateral error [m]": over(printed, largest_lateral_m).simulated}
        ),
        "soft": largest["multi-model"]._replace(
            beside={
                "no observer": largest["no observer"].simulated,
                "with preview": largest["multi-model with preview"].simulated,
                "median error ratio of the stiffness": over(soft["multi-model"], median_error).simulated,
            }
        ),
    }
    shown = {"multi-model": drives(trial, FAST_MPS, "multi-model")[0]}
    return Finding(numbers, {"stiffness": stiffness_figure(shown, "Cornering stiffness at 5 m/s")})


def misprints(trial: Trial) -> Finding:
    """Show the signs of (3): its eigenvalue, and where they send the cornering stiffness."""
    right, printed = (fastest_growth_ps(adap2e(), FAST_MPS, sign) for sign in (-1.0, 1.0))
    multi, wrong = (drives(trial, FAST_MPS, f"multi-model{kind}") for kind in ("", ", printed signs"))
    beside = {
        "at the end, right signs": over(multi, lambda one: float(one.stiffness_npr[-1].mean())).simulated,
        "median error ratio, printed": over(wrong, median_error).simulated,
        "lateral error in the S-bend [m]": over(wrong, lambda one: one.lateral_max_m(0.0, 58.0)).simulated,
    }
    numbers = {
        "eigenvalue": Numbers(right, beside={"as printed": printed}, values={"as_printed": printed}),
        "signs": over(wrong, lambda one: float(one.stiffness_npr.min()), beside, lower_limit=C_LOW_NPR),
        "gains": Numbers(15.0),
    }
    shown = {"right signs": multi[0], "printed signs": wrong[0]}
    figure = stiffness_figure(shown, "Cornering stiffness: right and printed signs")
    return Finding(numbers, {"signs": figure})


def fastest_growth_ps(robot: BicycleRobot, speed_mps: float, sign: float) -> float:
    """Return the largest real part of the eigenvalues of yaw rate and lateral speed.

    Parameters
    ----------
    robot : with its nominal cornering stiffness
    speed_mps : of the rear axle
    sign : of the forces and of v yaw' in line 2: -1 is right, 1 as printed

    Examples
    --------
    >>> round(fastest_growth_ps(adap2e(), 5.0, 1.0)), fastest_growth_ps(adap2e(), 5.0, -1.0) < 0
    (14, True)
    """
    front, rear = robot.com_behind_front_m, robot.com_ahead_m
    c_front, c_rear = robot.front_cornering_npr, robot.rear_cornering_npr
    slips = np.array([[front, 1.0], [-rear, 1.0]]) / speed_mps  # b_F, b_R by yaw rate and lateral speed
    matrix = np.array(
        [
            (rear * c_rear * slips[1] - front * c_front * slips[0]) / robot.yaw_inertia_kgm2,
            sign * ((c_front * slips[0] + c_rear * slips[1]) / robot.mass_kg + np.array([speed_mps, 0.0])),
        ]
    )
    return float(np.linalg.eigvals(matrix).real.max())


def grip_preview(trial: Trial) -> Finding:
    """Drive the trajectory of Fig. 7 with speed and steering previewed by the grip that was estimated."""
    lateral, preview = [], "multi-model with preview"
    for claim in trial.each["lateral"]:
        found = drives(trial, claim["speed"], preview)
        slowest = over(found, lambda drive: float(drive.speed_mps[drive.between(15.0, 95.0)].min())).simulated
        beside = {"slowest speed in the bends [m/s]": slowest, "bound, speed / 10": claim["speed"] / 10.0}
        reached = sum(drive.reached_end for drive in found)
        lateral.append(over(found, largest_lateral_m, beside, reached=reached, n=len(found)))
    found = drives(trial, FASTEST_MPS, preview)
    std = over(found, lambda one: float(one.grip_std[-1])).simulated
    beside = {"simulated tyre": GRIP_RATIO, "standard deviation by the filter": std}
    numbers = {"lateral": lateral, "grip": over(found, lambda one: float(one.grip_ratio[-1]), beside)}
    shown = {name: drives(trial, FASTEST_MPS, name)[0] for name in ("multi-model", preview)}
    drive = shown[preview]
    panels = (
        Panel((Line("speed", drive.distance_m, drive.speed_mps),), "speed [m/s]"),
        Panel((Line("steering", drive.distance_m, np.degrees(drive.steer_rad)),), "steering [deg]"),
    )
    figures = {
        "lateral": lateral_figure(shown, FASTEST_MPS / 10.0, "6 m/s: lateral errors"),
        "speed": Figure("6 m/s with the preview", panels, x_label="distance along the path [m]"),
    }
    return Finding(numbers, figures)


def map_figure(shown: Drives, course: str, title: str) -> Figure:
    """Draw the path and where robots were."""
    path = course_of(course).path
    lines = [Line("path", path.x_m, path.y_m, 6, dashed=True)]
    lines += [Line(name, *drive.position_m.T) for name, drive in shown.items()]
    return Figure(title, (Panel(tuple(lines), "y [m]", equal=True),), x_label="x [m]")


def lateral_figure(shown: Drives, limit_m: float, title: str) -> Figure:
    """Draw lateral errors over distance, with limits; beyond 1.5 m they leave the figure."""
    lines = [Line(name, drive.distance_m, drive.lateral_m) for name, drive in shown.items()]
    ends = np.array([0.0, max(float(drive.distance_m[-1]) for drive in shown.values())])
    bounds = [
        Line(f"{sign}speed / 10", ends, np.full(2, float(f"{sign}1") * limit_m), 6, dashed=True)
        for sign in "+-"
    ]
    largest = max(limit_m, *(float(np.abs(drive.lateral_m).max()) for drive in shown.values()))
    reach = 1.1 * min(largest, 1.5)
    panel = Panel((*lines, *bounds), "lateral error [m]", y_range=(-reach, reach))
    return Figure(title, (panel,), x_label="distance along the path [m]")


def sideslip_figure(drive: FollowedDrive, title: str) -> Figure:
    """Draw the slip angles of both axles over time, estimate beside truth."""
    panels = []
    for j, wheel in enumerate(WHEELS):
        estimate, std = np.degrees(drive.slip_rad[:, j]), np.degrees(drive.slip_std_rad[:, j])
        known = np.abs(estimate[np.isfinite(estimate)])
        reach = 1.4 * max(2.0, float(known.max(initial=0.0)))
        marks = (
            Band("± 2 std", drive.time_s, estimate - 2 * std, estimate + 2 * std, 0),
            Line("estimate", drive.time_s, estimate, 0),
            Line("true", drive.time_s, np.degrees(drive.slip_true_rad[:, j]), 6),
        )
        panels.append(Panel(marks, f"{wheel} [deg]", y_range=(-reach, reach)))
    return Figure(title, tuple(panels), x_label="time [s]")


def stiffness_figure(shown: Drives, title: str) -> Figure:
    """Draw the cornering stiffness of both axles over time, and the secant of the truth where excited."""

    def marks(name: str, drive: FollowedDrive, j: int) -> tuple[Mark, Mark]:
        estimate: Array = drive.stiffness_npr[:, j] / 1e3
        return (
            Line(name, drive.time_s, estimate),
            Points(f"true secant, {name}", drive.time_s, drive.secant_npr[:, j] / 1e3, colour=6),
        )

    panels = [
        Panel(
            tuple(mark for name, drive in shown.items() for mark in marks(name, drive, j)),
            f"{wheel} [kN/rad]",
            y_range=(0.0, 32.0),
        )
        for j, wheel in enumerate(WHEELS)
    ]
    return Figure(title, tuple(panels), x_label="time [s]")
