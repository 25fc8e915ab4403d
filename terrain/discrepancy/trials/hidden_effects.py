"""What a blind trial hides in simulated runs, drawn at random around the effects' detection limits.

The diagnosis gets run logs without truth and without source, and knows nothing of this module.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.trials.drives import Drives
from terrain.discrepancy.trials.limits import Limits, confusable_class
from terrain.discrepancy.trials.rows import Row
from terrain.effects import Effect, effect_named, library_of
from terrain.records import RunLog
from terrain.robots import Robot
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import simulate_planar

ROBOTS = ("agrimaro", "husky")
"""Trials take them in turn."""

STRONG = 3.0
"""Amplitude over the detection limit, of an effect that has to be named."""

LADDER = (0.1, 10.0)
"""Range of amplitudes over the limit, in row ``ladder``."""

FOUND_LADDER = (0.5, 6.5)
"""Range of amplitudes over the limit, in row ``found``."""

OUTSIDE = ("wheel_eccentricity", "motor_drift", "stick_slip", "clock_rate")
"""Hidden in row ``outside``: two effects that no library has, and two whose entry is taken out."""

ECCENTRICITY_RATIO, STICK_SLIP_A = (0.01, 0.04), (5.0, 20.0)
"""Ranges of the amplitudes of what no library has: a wheel's centre 2 to 8 mm off, spikes of a few ampere."""

ENTRY_TAKEN_OUT = (3.0, 10.0)
"""Range over the limit, of those whose entry is taken out."""


class Case(NamedTuple):
    """One trial to be done.

    Parameters
    ----------
    row, number : kind of the trial, and its number
    robot : name
    n_runs : in the trial
    seed : of all trials
    """

    row: Row
    number: int
    robot: str
    n_runs: int
    seed: int


class Hidden(NamedTuple):
    """What is hidden in the runs of a trial.

    Parameters
    ----------
    effects : values by parameter, of effects of the catalogue
    causes : names of the effects that the diagnosis may and should name
    over_limit : amplitude over the detection limit; 0 where nothing of the catalogue is hidden
    outside : name of what is hidden and not in the library; empty for none
    library : effects that the diagnosis may name
    outside_values : values by parameter, of what no library has
    """

    effects: dict[str, float]
    causes: tuple[str, ...]
    over_limit: float
    outside: str
    library: tuple[Effect, ...]
    outside_values: dict[str, float]


def cases_of(row: Row, n: int, seed: int, n_runs: int) -> list[Case]:
    """Return ``n`` cases of a row, the robots in turn."""
    return [Case(row, i, ROBOTS[i % len(ROBOTS)], n_runs, seed) for i in range(n)]


def draw_hidden(case: Case, robot: Robot, limits: Limits | None, rng: np.random.Generator) -> Hidden:
    """Draw what a trial hides.

    Parameters
    ----------
    limits : of the trial's drives; None where nothing is to be hidden
    """
    library = library_of(robot.drive)
    if limits is None:
        return Hidden({}, (), 0.0, "", library, {})
    if case.row is Row.OUTSIDE:
        return _draw_outside(case, limits, library, rng)
    acting = [effect for effect in library if not effect.modifies]  # the others do nothing alone
    if case.row is Row.FOUND:
        effect = acting[(case.number // len(ROBOTS)) % len(acting)]
        over = float(math.exp(rng.uniform(*np.log(FOUND_LADDER))))
        return Hidden(_values(effect, limits, over, rng), (effect.name,), over, "", library, {})
    effect = acting[int(rng.integers(len(acting)))]
    over = float(math.exp(rng.uniform(*np.log(LADDER)))) if case.row is Row.LADDER else STRONG
    values = _values(effect, limits, over, rng)
    if case.row is not Row.TWO:
        return Hidden(values, (effect.name,), over, "", library, {})
    others = [o for o in acting if o.name not in confusable_class(limits, effect, robot.drive)]
    others = [o for o in others if o.name not in [name for name, _ in effect.twins]]
    other = others[int(rng.integers(len(others)))]
    values |= _values(other, limits, over, rng)
    return Hidden(values, (effect.name, other.name), over, "", library, {})


def _draw_outside(
    case: Case, limits: Limits, library: tuple[Effect, ...], rng: np.random.Generator
) -> Hidden:
    """Draw an effect that the library does not have: its entry is taken out, or there never was one."""
    kind = OUTSIDE[(case.number // len(ROBOTS)) % len(OUTSIDE)]
    if kind in [effect.name for effect in library]:
        effect = effect_named(kind)
        over = float(rng.uniform(*ENTRY_TAKEN_OUT))
        rest = tuple(other for other in library if other is not effect)
        return Hidden(_values(effect, limits, over, rng), (), over, kind, rest, {})
    extra = {}
    if kind == "wheel_eccentricity":
        extra = {"wheel_eccentricity_ratio": float(rng.uniform(*ECCENTRICITY_RATIO))}
    elif kind == "stick_slip":
        extra = {"stick_slip_a": float(rng.uniform(*STICK_SLIP_A))}
    return Hidden({}, (), 0.0, kind, library, extra)


def _values(effect: Effect, limits: Limits, over: float, rng: np.random.Generator) -> dict[str, float]:
    """Return values of an effect, of an amplitude over its limit, in a random direction within its bounds."""
    low = np.array([p.low for p in effect.parameters])
    high = np.array([p.high for p in effect.parameters])
    direction = rng.standard_normal(len(effect.parameters))
    direction /= np.linalg.norm(direction)
    direction = np.where((low == 0.0) & (direction < 0), -direction, direction)
    amplitude = over * limits.of(effect, direction)
    values = np.clip(amplitude * direction, 0.9 * low, 0.9 * high)
    return {p.name: float(value) for p, value in zip(effect.parameters, values, strict=True)}


def hidden_runs(
    robot: Robot,
    drives: Drives,
    seed: np.random.SeedSequence,
    effects: Mapping[str, float],
    outside: Mapping[str, float] | None = None,
) -> tuple[RunLog, ...]:
    """Return the logs of drives with effects hidden in all of them; truth and source are removed."""
    scatter, noise = load_scatter(), load_noise()
    runs = []
    for i, (twist, hills) in enumerate(zip(drives.twists, drives.hills, strict=True)):
        run = simulate_planar(
            robot,
            twist,
            np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i)),
            effects=effects,
            scatter=scatter,
            noise=noise,
            hills=hills,
            outside=outside,
            run_id=f"run_{i + 1:02d}",
            terrain="ground",
        )
        shown = {name: stream for name, stream in run.streams.items() if name not in ("truth", "commands")}
        runs.append(replace(run, streams=shown, source=""))
    return tuple(runs)
