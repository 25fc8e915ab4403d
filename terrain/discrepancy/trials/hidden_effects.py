"""What a blind trial hides in simulated runs, drawn at random around the effects' detection limits.

The diagnosis gets run logs without truth and without source, and knows nothing of this module.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from terrain.discrepancy.trials.drives import STEP_HZ, Drives
from terrain.discrepancy.trials.limits import Limits, confusable_class
from terrain.discrepancy.trials.rows import Row
from terrain.effects import BOUNDS, Effect, effect_named, library_of
from terrain.records import RunLog, Stream
from terrain.robots import Robot
from terrain.simulation.planar.noise import Scatter, load_noise, load_scatter
from terrain.simulation.planar.run import simulate_planar

ROBOTS = ("agrimaro", "husky")
"""Trials take them in turn."""

ROBOTS_OF_ROW = {
    Row.SHORT: ROBOTS[1:],
    Row.KNOWN: ROBOTS[1:],
    Row.DYNAMIC: ROBOTS[:1],
    Row.TRACKED: ("patako", "marmotte"),
    Row.CAR: ("adap2e",),
}
"""Robots of rows that have others."""

SHORT_RUNS = 80
"""Number of runs where a run is one command of 6 s."""

STRONG = 3.0
"""Amplitude over the detection limit, of an effect that has to be named."""

CLIP_RATIO = 0.9
"""Ratio of the bounds of an effect, beyond which none is hidden."""

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
    """Return ``n`` cases of a row, the robots in turn where a row has several.

    The rows of 6 s a run have :data:`SHORT_RUNS` of the skid-steer robot whatever is asked for.
    """
    robots = ROBOTS_OF_ROW.get(row, ROBOTS)
    n_runs = SHORT_RUNS if row in (Row.SHORT, Row.KNOWN) else n_runs
    return [Case(row, i, robots[i % len(robots)], n_runs, seed) for i in range(n)]


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
        return Hidden(values_of(effect, limits, over, rng), (effect.name,), over, "", library, {})
    effect = acting[int(rng.integers(len(acting)))]
    over = float(math.exp(rng.uniform(*np.log(LADDER)))) if case.row is Row.LADDER else STRONG
    values = values_of(effect, limits, over, rng)
    if case.row is not Row.TWO:
        return Hidden(values, (effect.name,), over, "", library, {})
    others = [o for o in acting if o.name not in confusable_class(limits, effect, robot.drive)]
    others = [o for o in others if o.name not in [name for name, _ in effect.twins]]
    others = [o for o in others if not _is_another_pair(limits, (effect, o), acting)]
    other = others[int(rng.integers(len(others)))]
    values |= values_of(other, limits, over, rng)
    return Hidden(values, (effect.name, other.name), over, "", library, {})


def _is_another_pair(limits: Limits, pair: tuple[Effect, Effect], library: Sequence[Effect]) -> bool:
    """Return whether a third effect can take the place of one of two: no log distinguishes them then."""
    rest = [
        other for other in library if other not in pair and not any(limits.alike(one, other) for one in pair)
    ]
    return any(limits.spanned(pair, third) for third in rest)


def _draw_outside(
    case: Case, limits: Limits, library: tuple[Effect, ...], rng: np.random.Generator
) -> Hidden:
    """Draw an effect that the library does not have: its entry is taken out, or there never was one."""
    kind = OUTSIDE[(case.number // len(ROBOTS)) % len(OUTSIDE)]
    if kind in [effect.name for effect in library]:
        effect = effect_named(kind)
        over = float(rng.uniform(*ENTRY_TAKEN_OUT))
        rest = tuple(other for other in library if other is not effect)
        return Hidden(values_of(effect, limits, over, rng), (), over, kind, rest, {})
    extra = {}
    if kind == "wheel_eccentricity":
        extra = {"wheel_eccentricity_ratio": float(rng.uniform(*ECCENTRICITY_RATIO))}
    elif kind == "stick_slip":
        extra = {"stick_slip_a": float(rng.uniform(*STICK_SLIP_A))}
    return Hidden({}, (), 0.0, kind, library, extra)


def values_of(effect: Effect, limits: Limits, over: float, rng: np.random.Generator) -> dict[str, float]:
    """Return values of an effect, of an amplitude over its limit, in a random direction within its bounds."""
    low = np.array([p.low for p in effect.parameters])
    high = np.array([p.high for p in effect.parameters])
    direction = rng.standard_normal(len(effect.parameters))
    direction /= np.linalg.norm(direction)
    direction = np.where((low == 0.0) & (direction < 0), -direction, direction)
    amplitude = over * limits.of(effect, direction)
    values = np.clip(amplitude * direction, CLIP_RATIO * low, CLIP_RATIO * high)
    return {p.name: float(value) for p, value in zip(effect.parameters, values, strict=True)}


def is_clipped(values: Mapping[str, float]) -> bool:
    """Return whether :func:`values_of` clipped a value.

    Examples
    --------
    >>> is_clipped({"gyro_scale_ratio": 0.135}), is_clipped({"gyro_scale_ratio": 0.13})
    (True, False)
    """
    return any(
        value != 0.0 and value in [CLIP_RATIO * bound for bound in BOUNDS[name]]
        for name, value in values.items()
    )


def hidden_runs(
    robot: Robot,
    drives: Drives,
    seed: np.random.SeedSequence,
    effects: Mapping[str, float] | Sequence[Mapping[str, float]],
    outside: Mapping[str, float] | None = None,
    *,
    scatter: Scatter | None = None,
    heading: bool = False,
) -> tuple[RunLog, ...]:
    """Return the logs of drives with effects hidden in all of them; truth and source are removed.

    Parameters
    ----------
    effects : values by parameter, of all runs or of each one
    outside : amplitudes of what no library has
    scatter : of the runs; that of the package by default
    heading : log a heading that does not depend on the gyro, too
    """
    scatter, noise = scatter or load_scatter(), load_noise()
    each = [effects] * len(drives.twists) if isinstance(effects, Mapping) else effects
    runs = []
    for i, (twist, hills, own) in enumerate(zip(drives.twists, drives.hills, each, strict=True)):
        run = simulate_planar(
            robot,
            twist,
            np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, i)),
            effects=own,
            scatter=scatter,
            noise=noise,
            hills=hills,
            outside=outside,
            heading=heading,
            run_id=f"run_{i + 1:02d}",
            terrain="ground",
        )
        shown = {name: stream for name, stream in run.streams.items() if name not in ("truth", "commands")}
        rate = own.get("clock_rate_ratio", 0.0)
        runs.append(_after(replace(run, streams=shown, source=""), drives.lead_s, rate))
    return tuple(runs)


def _after(run: RunLog, lead_s: float, clock_rate_ratio: float) -> RunLog:
    """Return a run from a time on, which becomes the 0 of its clocks: none has drifted there."""
    if lead_s == 0.0:
        return run
    streams = {}
    for name, stream in run.streams.items():
        kept = stream.time_s >= lead_s - 0.5 / (2.0 * STEP_HZ)
        ahead_s = 0.0 if name == "wheels" else clock_rate_ratio * lead_s
        time_s = stream.time_s[kept] - lead_s - ahead_s
        streams[name] = Stream(time_s, stream.values[kept], stream.channels)
    labels = tuple(label._replace(end_s=label.end_s - lead_s) for label in run.labels)
    return replace(run, streams=streams, labels=labels)
