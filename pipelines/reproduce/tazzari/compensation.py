"""The future work of Tazzari et al.: the observer in the loop of a controller that compensates slip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.reporting.drawing import BLUE, INK, VERMILION
from pipelines.reporting.line_figure import Line
from pipelines.reproduce.over_runs import OverRuns, over_runs
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.reproduce.tazzari.figures import Panel, panels_figure
from pipelines.reproduce.tazzari.runs import NORMALISED, orchard_ugv, rms, seeds
from terrain.control.tracked_speed import track_speed_params, track_speed_step
from terrain.estimation.observers.tracked import tracked_observer
from terrain.records import Array
from terrain.simulation.tracked.contact import contact_array
from terrain.simulation.tracked.motion import STATE_SIZE, STEP_S, VX, YAW, W, X, advance
from terrain.simulation.tracked.run import NOISY
from terrain.simulation.tracked.slope import LEVEL
from terrain.terramechanics.soil import load_soil

FORWARD_MPS, TURN_RADPS = 0.5, 0.15
DURATION_S, SETTLED_S = 60.0, 15.0
SOILS, FIRST_M = ("grass", "dry_sand"), 10.0
"""The soil changes after a distance; on both a turn needs much of the friction."""
TICK_S, FIX_TICKS = 0.02, 5


class Held(NamedTuple):
    """Forward and turning speed (n, 2) at the ticks (n,), and the efficiencies (n, 2) that were used."""

    time_s: Array
    speed: Array
    eta: Array


def compensation(seed: int, quick: bool) -> Finding:
    """Drive a turn over a change of soil, with and without the estimated efficiencies."""
    duration_s = DURATION_S / (2.0 if quick else 1.0)
    runs = {
        compensated: [closed_loop(each, duration_s, compensated) for each in seeds(seed, quick)]
        for compensated in (True, False)
    }
    held, plain = runs[True], runs[False]
    rows = [
        _row("Forward speed", "m/s", over_runs(_off(held, 0)), over_runs(_off(plain, 0)).mean, FORWARD_MPS),
        _row("Turning speed", "rad/s", over_runs(_off(held, 1)), over_runs(_off(plain, 1)).mean, TURN_RADPS),
    ]
    return Finding(rows, [_picture(held[0], plain[0])])


def closed_loop(seed: np.random.SeedSequence, duration_s: float, compensated: bool) -> Held:
    """Return what a vehicle does whose tracks follow the commands with a lag, on two soils.

    Parameters
    ----------
    seed : of the noise of fixes, compass and gyro
    duration_s : of the run
    compensated : whether the estimated efficiencies are used; else they are taken for 1
    """
    robot, rng = orchard_ugv(), np.random.default_rng(seed)
    grounds = np.array([contact_array(robot, load_soil(name)) for name in SOILS])
    given, until_m, level = np.zeros((2, 7)), np.array([FIRST_M, np.inf]), np.array(LEVEL)
    params, observer = track_speed_params(robot), tracked_observer(robot, NORMALISED)
    memory, used, state, belts = np.array(observer.start), np.ones(2), np.zeros(STATE_SIZE), np.zeros(2)
    noise = np.array([NOISY.gnss_m, NOISY.gnss_m, NOISY.compass_rad])
    keep, n = np.exp(-STEP_S / NOISY.belt_lag_s), round(duration_s / TICK_S)
    speed, etas = np.empty((n, 2)), np.empty((n, 2))
    for k in range(n):
        reading = observer.read(observer.params, memory)
        eta, std = (reading.mean[5:7], reading.std[5:7]) if compensated else (np.ones(2), np.zeros(2))
        command = track_speed_step(params, used, FORWARD_MPS, TURN_RADPS, eta, std, TICK_S)
        used = command.eta
        for _ in range(round(TICK_S / STEP_S)):
            belts = keep * belts + (1.0 - keep) * np.array([command.left_mps, command.right_mps])
            state = advance(grounds, given, until_m, robot.half_track_m, level, state, belts, STEP_S)
        row = np.full(6, np.nan)
        row[:2] = belts + NOISY.encoder_mps * rng.standard_normal(2)
        row[5] = state[W] + NOISY.gyro_radps * rng.standard_normal()
        if k % FIX_TICKS == 0:
            row[2:5] = state[X : YAW + 1] + noise * rng.standard_normal(3)
        memory = observer.step(observer.params, memory, row, TICK_S)
        speed[k], etas[k] = state[[VX, W]], used
    return Held(TICK_S * np.arange(1, n + 1), speed, etas)


def _off(runs: list[Held], which: int) -> list[float]:
    desired = (FORWARD_MPS, TURN_RADPS)[which]
    return [rms(run.speed[run.time_s > SETTLED_S, which] - desired) for run in runs]


def _row(what: str, unit: str, off: OverRuns, plain: float, desired: float) -> Row:
    return Row(
        what=f"{what}, root mean square from the desired {desired:g} {unit}",
        where="VI, future work",
        printed="no result",
        simulated=off.mean,
        spread=off.spread,
        unit=unit,
        verdict=Verdict.NOT_PRINTED,
        why="A left turn that comes from grass onto dry sand, by the forces under the tracks: the speeds of "
        "the tracks are the desired ones over the estimated efficiencies.",
        beside={"without compensation": plain},
    )


def _picture(held: Held, plain: Held) -> Picture:
    names = (("forward speed [m/s]", FORWARD_MPS), ("turning speed [rad/s]", TURN_RADPS))
    panels = [
        Panel(
            "time [s]",
            label,
            [
                Line(plain.time_s, plain.speed[:, k], VERMILION, "plain"),
                Line(held.time_s, held.speed[:, k], BLUE, "compensated"),
                Line(held.time_s, np.full(len(held.time_s), desired), INK, "desired"),
            ],
        )
        for k, (label, desired) in enumerate(names)
    ]
    return Picture(
        "A turn from grass onto dry sand with and without compensation of the estimated slip.",
        panels_figure("Desired speeds are held by compensating the slip", panels),
    )
