"""Sections 4.3 to 4.6 of Danzi, AgriMaRo thesis: filters without a measurement of the speed over ground."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, INK, VERMILION
from pipelines.reporting.line_figure import Line, lines_figure
from pipelines.reproduce.danzi.observability import straight_line_rank
from pipelines.reproduce.danzi.runs import (
    NO_SLIP_RATIO,
    ROBOT,
    START_S,
    seeded_runs,
    steady_mean,
    true_slip,
)
from pipelines.reproduce.over_runs import OverRuns, over_runs
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, holds, verdict_of
from terrain.estimation.estimate import Estimate, estimate_run
from terrain.records import Array
from terrain.robots import Robot, load_robot


def blind_filters(seed: int, quick: bool) -> Finding:
    """Estimate slip on grass at 1 m/s by the filters with 12 and with 14 states; rank of their states."""
    robot = load_robot(ROBOT)
    runs = seeded_runs(robot, "grass", "straight", seed, quick)
    encoder = [estimate_run(run, robot, "encoder12", tuning="thesis") for run in runs]
    slip = [estimate_run(run, robot, "slip14", tuning="thesis") for run in runs]
    true = over_runs([steady_mean(true_slip(one), one) for one in encoder])
    picture = Picture(
        "One run on grass: the slip estimated with 12 states stays at zero, the slip states of the filter "
        "with 14 diverge; neither follows the true slip.",
        _blind_figure(encoder[0], slip[0]),
    )
    return Finding([_twelve_states(encoder, true), _fourteen_states(slip, true), _rank(robot)], [picture])


def _twelve_states(encoder: list[Estimate], true: OverRuns) -> Row:
    estimated = over_runs([steady_mean(one.blind.slip_ratio, one) for one in encoder])
    zero = (-NO_SLIP_RATIO, NO_SLIP_RATIO)
    return Row(
        what="Slip on grass by the 12 states without a camera",
        where="4.6",
        printed="zero, systematically",
        printed_interval=zero,
        simulated=estimated.mean,
        spread=estimated.spread,
        unit="ratio",
        verdict=verdict_of(estimated.mean, zero),
        why="The filter assumes that the speed of the robot is that of the wheels. Zero is within 0.01, as "
        "on tiles in 7.2.3.",
        beside={"true slip": true.mean},
    )


def _fourteen_states(slip: list[Estimate], true: OverRuns) -> Row:
    estimated = over_runs([steady_mean(_slip_states(one), one) for one in slip])
    low, high = true.spread
    return Row(
        what="Slip on grass by the 14 states, which include a slip ratio for each wheel",
        where="4.5",
        printed="large errors, and instability",
        simulated=estimated.mean,
        spread=estimated.spread,
        unit="ratio",
        verdict=holds(not low <= estimated.mean <= high),
        why="No measurement constrains the slip states, and they drift together with the speed: any pair of "
        "the two explains the wheel speeds. A slip ratio beyond 1 is impossible.",
        beside={"true slip": true.mean},
    )


def _rank(robot: Robot) -> Row:
    printed = straight_line_rank("slip14", robot, as_printed=True)
    corrected = straight_line_rank("slip14", robot)
    others = {name: straight_line_rank(name, robot) for name in ("encoder12", "vio12", "vio15")}
    return Row(
        what="Independent states that are observable by the 14-state filter when driving straight, of "
        f"{printed.total}",
        where="4.5.1, (4.28)",
        printed="not examined; the nonlinearity of 1/(1 - s) is blamed",
        printed_interval=(printed.total, printed.total),
        simulated=printed.observable,
        unit="states",
        verdict=Verdict.CORRECTED if printed.observable < printed.total else Verdict.DIFFERS,
        why="The cause is observability: no row measures the speed over ground, and no other filter on the "
        f"same rows can do better. {printed.total} are all states but the position; the number is the rank "
        "of the local observability matrix at 0.875 m/s with a slip of 0.125.",
        beside={
            "with rows 4 and 5 corrected to the accelerations": corrected.observable,
            **{f"{name}, of {rank.total}": rank.observable for name, rank in others.items()},
        },
    )


def _slip_states(estimate: Estimate) -> Array:
    return np.column_stack([estimate.track.state(f"slip_{wheel}_ratio") for wheel in estimate.robot.wheels])


def _blind_figure(encoder: Estimate, slip: Estimate) -> Figure:
    time_s = encoder.track.time_s
    moving = time_s > START_S[0] + 0.5
    curves = {
        "true": (true_slip(encoder), INK),
        "12 states, without a camera": (encoder.blind.slip_ratio, BLUE),
        "14 states": (_slip_states(slip), VERMILION),
    }
    return lines_figure(
        "Slip without a measurement of the speed over ground, grass",
        "slip, mean of the wheels",
        [
            Line(time_s[moving], values.mean(axis=1)[moving], colour, label)
            for label, (values, colour) in curves.items()
        ],
    )
