"""Experiment II of Yamauchi et al., first half (figs. 7 and 13): the exponent n of Endo's law in turns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, GREEN, INK, VERMILION
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, verdict_of
from pipelines.reproduce.yamauchi.figures import Mark, Panel, panels_figure
from pipelines.reproduce.yamauchi.trials import (
    FEW_REPEATS,
    RATES_DPS,
    REPEATS,
    SAND,
    SLOPES_DEG,
    SPEED_MPS,
    UPHILL,
    Trial,
    patako,
    run_trial,
    turning_trials,
)
from terrain.bootstrap import percentile_interval
from terrain.calibration.track_motion import SlipSamples, slip_samples
from terrain.calibration.turning_exponent import fit_turning
from terrain.records import Array
from terrain.simulation.tracked.given_slip import GivenSlip
from terrain.simulation.tracked.run import simulate_tracked
from terrain.terramechanics.soil import load_soil

PRINTED_FLOOR, PRINTED_SAND = 0.847, 0.873
FIRM = "firm_soil_gravel"
"""Firm ground in place of the paper's linoleum: tracks are simulated on ground that shears."""

EXPONENTS = (0.3, 0.6, 0.847, 1.0, 1.3)
HIDDEN_LOSS = 0.36
N_DRAWS, FEW_DRAWS = 200, 20


class Exponent(NamedTuple):
    """n with the interval of a bootstrap over trials."""

    value: float
    interval: tuple[float, float]


def turning_law(seed: int, quick: bool) -> Finding:
    """Find n on firm ground and on sand, by the speed of the body and by logarithms."""
    repeats, robot = FEW_REPEATS if quick else REPEATS, patako()
    n_draws = FEW_DRAWS if quick else N_DRAWS
    trials = turning_trials(seed, repeats, (UPHILL,))
    sand = slip_samples([run_trial(trial) for trial in trials], robot).turning
    floor = slip_samples(
        [run_trial(trial, load_soil(FIRM)) for trial in _floor_trials(seed, 3)], robot
    ).turning
    found = {
        "sand": _exponent(sand, grade=True, n_draws=n_draws, seed=seed),
        "sand_as_printed": _exponent(sand, grade=False, n_draws=n_draws, seed=seed),
        "floor": _exponent(floor, grade=False, n_draws=n_draws, seed=seed),
    }
    lines = {"sand": _log_line(sand), "floor": _log_line(floor)}
    of_slope = {
        f"{slope:g} deg": fit_turning(
            sand.where(np.array([trial.slope_deg == slope for trial in trials])[sand.run]),
            robot.half_track_m,
            grade=False,
        ).exponent
        for slope in SLOPES_DEG
    }
    rows = [*_rows(found, lines, of_slope), _hidden(seed, quick)]
    return Finding(rows, [Picture(_CAPTION, _figure(sand, floor, found, lines))])


_CAPTION = (
    "Magnitude of the ratio of the slip ratios over that of the speeds of the tracks, in turns on sand "
    "of four slopes and on firm ground, with the line of Endo's law by the speed of the body and by "
    "logarithms as in the paper. Points with little slip scatter over decades: a logarithm of noise over "
    "noise."
)


def _floor_trials(seed: int, repeats: int) -> list[Trial]:
    first = 1_000_000 * (seed + 1) + 300_000
    cases = [rate for _ in range(repeats) for rate in RATES_DPS]
    return [Trial(0.0, rate, UPHILL, first + k) for k, rate in enumerate(cases)]


def _exponent(samples: SlipSamples, *, grade: bool, n_draws: int, seed: int) -> Exponent:
    """Return n, and its interval by drawing trials with replacement."""
    half = patako().half_track_m
    runs = np.unique(samples.run)
    rows = {run: np.flatnonzero(samples.run == run) for run in runs}
    rng, draws = np.random.default_rng(seed), []
    for _ in range(n_draws):
        drawn = rng.choice(runs, len(runs))
        chosen = np.concatenate([rows[run] for run in drawn])
        number = np.repeat(np.arange(len(runs)), [len(rows[run]) for run in drawn])
        part = samples.where(chosen)._replace(run=number)
        draws.append(fit_turning(part, half, grade=grade).exponent)
    value = fit_turning(samples, half, grade=grade).exponent
    return Exponent(value, percentile_interval(np.array(draws)))


def _log_ratios(samples: SlipSamples) -> tuple[Array, Array]:
    """Return ln |v_r / v_l| and ln |alpha_l / alpha_r|, with the slip of each track by its own truth."""
    half = patako().half_track_m
    ground = [samples.forward_mps + sign * half * samples.yaw_rate_radps for sign in (-1.0, 1.0)]
    slips = [1.0 - own / v for own, v in zip(ground, (samples.left_mps, samples.right_mps), strict=True)]
    return np.log(np.abs(samples.right_mps / samples.left_mps)), np.log(np.abs(slips[0] / slips[1]))


def _log_line(samples: SlipSamples) -> tuple[float, float]:
    """Return slope and intercept of the paper's line through the logarithms."""
    slope, intercept = np.polyfit(*_log_ratios(samples), 1)
    return float(slope), float(intercept)


def _hidden(seed: int, quick: bool) -> Row:
    """Return how well a given n comes back: the simulator follows Endo's law."""
    errors, robot = {}, patako()
    rates = (10.0, 16.0, 20.0, 30.0)
    for place, n in enumerate(EXPONENTS[:: 2 if quick else 1]):
        ground, runs = GivenSlip(turning_loss_ratio=HIDDEN_LOSS, turning_exponent=n), []
        for k in range(16):
            w = np.radians(rates[k % 4])
            half = robot.half_track_m * w
            steps = int(50 * (1.0 + 0.5 * np.pi / w / (1.0 - HIDDEN_LOSS)))
            belts = np.tile([SPEED_MPS - half, SPEED_MPS + half], (steps, 1))
            entropy = np.random.SeedSequence([seed, place, k])
            runs.append(simulate_tracked(robot, ground, belts, entropy))
        errors[f"n = {n:g}"] = fit_turning(slip_samples(runs, robot).turning, robot.half_track_m).exponent - n
    worst = max(errors.values(), key=abs)
    return Row(
        what="Error of n where the simulator follows Endo's law with an n of its own, the largest",
        where="(27), future work",
        printed="not evaluated",
        simulated=worst,
        unit="ratio",
        verdict=Verdict.NOT_PRINTED,
        why="Sixteen turns of 90°, encoders with 1 mm/s, gyro with 0.003 rad/s, cameras with 1 mm at 100 "
        "Hz; within 0.02 is required.",
        beside=errors,
    )


def _rows(
    found: dict[str, Exponent], lines: dict[str, tuple[float, float]], of_slope: dict[str, float]
) -> list[Row]:
    sand, plain, floor = (found[name] for name in ("sand", "sand_as_printed", "floor"))
    return [
        Row(
            what="Exponent n in turns on sand, slopes of 0° to 15°",
            where="fig. 13",
            printed=f"{PRINTED_SAND}",
            printed_interval=(PRINTED_SAND, PRINTED_SAND),
            simulated=sand.value,
            spread=sand.interval,
            unit="ratio",
            verdict=verdict_of(sand.value, (PRINTED_SAND, PRINTED_SAND), sand.interval),
            why="By least squares on the speed of the body, with what a grade adds in a turn. Numbers of "
            "the sand were assumed, and n goes with the shear modulus. Beside it n as printed, without a "
            "part for the grade, and by logarithms as in fig. 13.",
            beside={"as printed": plain.value, "by logarithms": lines["sand"][0]},
        ),
        Row(
            what="Exponent n on level firm ground",
            where="fig. 7",
            printed=f"{PRINTED_FLOOR}",
            printed_interval=(PRINTED_FLOOR, PRINTED_FLOOR),
            simulated=floor.value,
            spread=floor.interval,
            unit="ratio",
            verdict=verdict_of(floor.value, (PRINTED_FLOOR, PRINTED_FLOOR), floor.interval),
            why="The paper's floor is rigid linoleum; the simulated ground is firm soil that shears, "
            "with the interval of nine turns.",
            beside={"by logarithms": lines["floor"][0]},
        ),
        Row(
            what="n on sand less n on firm ground",
            where="discussion",
            printed="0.026: does not change with the environment",
            printed_interval=(PRINTED_SAND - PRINTED_FLOOR, PRINTED_SAND - PRINTED_FLOOR),
            simulated=sand.value - floor.value,
            spread=(sand.interval[0] - floor.interval[1], sand.interval[1] - floor.interval[0]),
            unit="ratio",
            verdict=verdict_of(
                sand.value - floor.value,
                (PRINTED_SAND - PRINTED_FLOOR, PRINTED_SAND - PRINTED_FLOOR),
                (sand.interval[0] - floor.interval[1], sand.interval[1] - floor.interval[0]),
            ),
            why="By forces n is no constant of the robot. Beside it n of each slope alone, as printed, "
            "in turns uphill: with the grade in the speed but not in the law, n takes up what the grade "
            "does.",
            beside=of_slope,
        ),
    ]


def _figure(
    sand: SlipSamples,
    floor: SlipSamples,
    found: dict[str, Exponent],
    lines: dict[str, tuple[float, float]],
) -> Figure:
    panels: list[Panel] = []
    for name, samples in (("sand", sand), ("floor", floor)):
        x, y = _log_ratios(samples)
        ends = np.array([x.min(), x.max()])
        slope, intercept = lines[name]
        marks: Sequence[Mark] = [
            Mark(x, y, BLUE, "samples", joined=False),
            Mark(ends, found[name].value * ends, VERMILION, "by the speed"),
            Mark(ends, slope * ends + intercept, GREEN, "by logarithms", dashed=True),
            Mark(ends, PRINTED_SAND * ends, INK, "n = 0.873", dashed=True),
        ]
        title = f"{SAND if name == 'sand' else FIRM}".replace("_", " ")
        panels.append(Panel(title, "ln |v_r / v_l|", "ln |alpha_l / alpha_r|", marks))
    return panels_figure("Ratio of the slip ratios over the ratio of the speeds of the tracks", panels)
