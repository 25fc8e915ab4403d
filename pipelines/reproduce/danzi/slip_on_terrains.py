"""Section 7.2.3 of Danzi, AgriMaRo thesis: slip in a start and in steady driving on three terrains."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.estimate.figures import slip_figure
from pipelines.reporting.numbers import format_number
from pipelines.reproduce.danzi.runs import (
    NO_SLIP_RATIO,
    ROBOT,
    Curve,
    curve_of,
    estimate_with_both_filters,
    extreme_in_start,
    lagged_truth,
    seeded_runs,
    steady_mean,
    true_slip,
)
from pipelines.reproduce.over_runs import over_runs
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, verdict_of
from terrain.estimation.estimate import Estimate
from terrain.robots import load_robot
from terrain.slip import MIN_SPEED_MPS


class PrintedSlip(NamedTuple):
    """What the thesis prints for a terrain, the origin of the soil parameters, and comments on both.

    Parameters
    ----------
    terrain : name of the soil
    figure : number in the thesis
    steady : (low, high) slip ratio in steady driving
    peak : slip ratio in the start
    is_fitted : whether parameters of the soil were identified from these figures
    why_steady, why_peak : sentences of the rows
    """

    terrain: str
    figure: str
    steady: tuple[float, float]
    peak: float
    is_fitted: bool
    why_steady: str
    why_peak: str

    @property
    def name(self) -> str:
        """Name of the terrain in a sentence."""
        return self.terrain.replace("_", " ")

    def verdict(self, verdict: Verdict) -> Verdict:
        """Return the verdict, given that agreement with a fitted figure is no independent check."""
        return Verdict.ASSUMED if verdict is Verdict.AS_PRINTED and self.is_fitted else verdict


PRINTED = (
    PrintedSlip(
        "tiles",
        "7.2",
        (-NO_SLIP_RATIO, NO_SLIP_RATIO),
        0.16,
        False,
        "An independent check: no parameter of the tiles was taken from this figure.",
        "On a hard floor 1 m/s² needs a slip of 0.01, and the lag of the encoders reduces the estimate. The "
        "thesis itself doubts its 0.16, which may be an effect of its smoothing of encoders with few steps "
        "per turn.",
    ),
    PrintedSlip(
        "grass",
        "7.3",
        (0.116, 0.135),
        0.339,
        True,
        "Not an independent check: the friction angle of the grass was identified from this slip. The "
        "filter underestimates it; see 6.1, below.",
        "The shear modulus was chosen so that an accelerating wheel slips 0.34. The filter underestimates "
        "the true slip because its encoders lag; the smoothing of the slip shown in the thesis is not "
        "printed.",
    ),
    PrintedSlip(
        "firm_soil_gravel",
        "7.4",
        (0.122, 0.146),
        0.475,
        True,
        "Not an independent check: the friction angle of the gravel was identified from this slip; the "
        "filter underestimates it.",
        "The shear modulus was chosen so that an accelerating wheel slips 0.47; the filter underestimates "
        "the true slip, as on grass.",
    ),
)


class Curves(NamedTuple):
    """Slip of the runs on one terrain."""

    vio12: list[Curve]
    vio15: list[Curve]
    true: list[Curve]


def slip_on_terrains(seed: int, quick: bool) -> Finding:
    """Estimate slip from rest at 1 m/s^2 to 1 m/s, straight ahead, on three terrains."""
    robot = load_robot(ROBOT)
    rows: list[Row] = []
    pictures, peaks = [], []
    for printed in PRINTED:
        runs = seeded_runs(robot, printed.terrain, "straight", seed, quick)
        thesis, vio15 = estimate_with_both_filters(runs, robot)
        curves = Curves(
            vio12=[curve_of(one) for one in thesis],
            vio15=[curve_of(one) for one in vio15],
            true=[lagged_truth(run, robot) for run in runs],
        )
        rows += [_steady_row(printed, thesis, vio15), _peak_row(printed, curves)]
        peaks.append([extreme_in_start(curve, np.max) for curve in curves.vio12])
        pictures.append(
            Picture(
                f"A start at 1 m/s² and steady driving on {printed.name} by the thesis' filter (thesis, "
                f"figure {printed.figure}): wheel speeds and speed over ground, and the slip between them "
                "beside the true slip.",
                slip_figure(thesis[0]),
            )
        )
    return Finding([*rows, _order_of_peaks(peaks)], pictures)


def _steady_row(printed: PrintedSlip, thesis: list[Estimate], vio15: list[Estimate]) -> Row:
    steady = over_runs([steady_mean(one.slip.slip_ratio, one) for one in thesis])
    return Row(
        what=f"Steady slip on {printed.name}, by the thesis' filter",
        where=f"7.2.3, figure {printed.figure}",
        printed=f"{format_number(printed.steady[0])} to {format_number(printed.steady[1])}",
        printed_interval=printed.steady,
        simulated=steady.mean,
        spread=steady.spread,
        unit="ratio",
        verdict=printed.verdict(verdict_of(steady.mean, printed.steady)),
        why=printed.why_steady,
        beside={
            "true": over_runs([steady_mean(true_slip(one), one) for one in thesis]).mean,
            "vio15": over_runs([steady_mean(one.slip.slip_ratio, one) for one in vio15]).mean,
        },
    )


def _peak_row(printed: PrintedSlip, curves: Curves) -> Row:
    peak, vio15, true = (
        over_runs([extreme_in_start(curve, np.max) for curve in row])
        for row in (curves.vio12, curves.vio15, curves.true)
    )
    early = over_runs([extreme_in_start(curve, np.max, MIN_SPEED_MPS) for curve in curves.vio12])
    interval = (printed.peak, printed.peak)
    return Row(
        what=f"Peak of the slip in the start on {printed.name}, from 0.2 m/s on, by the thesis' filter",
        where=f"7.2.3, figure {printed.figure}",
        printed=format_number(printed.peak),
        printed_interval=interval,
        simulated=peak.mean,
        spread=peak.spread,
        unit="ratio",
        verdict=printed.verdict(verdict_of(peak.mean, interval, peak.spread)),
        why=printed.why_peak,
        beside={"true": true.mean, "vio15": vio15.mean, "from 0.05 m/s on": early.mean},
    )


def _order_of_peaks(peaks: list[list[float]]) -> Row:
    """Compare the order of the peaks (terrains, runs) with the printed one."""
    in_order = float(np.mean([list(run) == sorted(run) for run in zip(*peaks, strict=True)]))
    return Row(
        what="Runs in which the peaks increase from tiles to grass to gravel",
        where="7.2.3",
        printed="0.16, 0.339, 0.475",
        printed_interval=(1.0, 1.0),
        simulated=in_order,
        unit="(fraction of the runs)",
        verdict=verdict_of(in_order, (1.0, 1.0)),
        why="Gravel has the smallest reserve of traction in a start, tiles the largest. Grass and gravel "
        "have the same shear modulus.",
    )
