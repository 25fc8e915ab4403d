"""Blind trials of the diagnosis: one side hides effects, the other answers, and how often they agree."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import beta

from pipelines.reporting.progress import Progress, silent
from terrain.discrepancy.diagnose import MIN_RUNS, diagnose
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.trials.hidden_effects import (
    Limits,
    confusable_class,
    hidden_runs,
    limits_of,
    poor_drives,
    rich_drives,
)
from terrain.discrepancy.verdict import AMBIGUOUS, NOT_EXCITED, Diagnosis
from terrain.effects import Effect, effect_named, library_of, nuisances_of
from terrain.errors import ConfigError, DataError
from terrain.records import Array
from terrain.robots import Robot, load_robot
from terrain.simulation.planar.model import Ground
from terrain.simulation.planar.noise import load_scatter

ROBOTS = ("agrimaro", "husky")
"""Trials take them in turn."""

STRONG = 3.0
"""Times its limit, of an effect that has to be named."""

LADDER = (0.1, 10.0)
"""Range of amplitudes over the limit, of the row in which they differ."""

FOUND_LADDER = (0.5, 6.5)
"""Range of amplitudes over the limit, where it is asked from which on nine in ten are found."""

OUTSIDE = ("wheel_eccentricity", "motor_drift", "stick_slip", "clock_rate")
"""Hidden, and not in the library: two that no library has, and two whose entry is taken out."""

ECCENTRICITY_RATIO, STICK_SLIP_A = (0.01, 0.04), (5.0, 20.0)
"""Range of the amplitudes of what no library has: a wheel's centre 2 to 8 mm off, spikes of a few ampere."""

ENTRY_TAKEN_OUT = (3.0, 10.0)
"""Range over the limit, of those whose entry is taken out."""

ROWS: tuple[str, ...] = ("none", "strong", "ladder", "found", "two", "outside", "poor")
"""What is hidden: nothing; one effect of 3 times its limit; one of any size; each effect in turn, around its
limit; two effects; something that is not in the library; and one effect under driving that shows little."""

REFUSED = "refused"
"""In place of a verdict, where the diagnosis would not have the runs: too few of them seemed to belong."""

FOUND_TRIALS = 5
"""Trials of an effect from which on it is said from which amplitude on it is found."""


class Case(NamedTuple):
    """One trial to be done.

    Parameters
    ----------
    row, number : which of :data:`ROWS`, and its number
    robot : name
    n_runs : in the trial
    seed : of all trials
    """

    row: str
    number: int
    robot: str
    n_runs: int
    seed: int


@dataclass(frozen=True, slots=True)
class Trial:
    """What was hidden, and what was answered.

    Parameters
    ----------
    row, number, robot, n_runs : of the case
    hidden : values by parameter
    causes : names of the effects hidden
    outside : name of what is hidden and not in the library
    over_limit : amplitude over the limit, of a single effect
    classes : by cause, the effects of its confusable class
    verdict, named, sets, unexplained : the answer
    intervals : by parameter named, value and interval
    gain_low : lower end of the smallest held-out gain of a cause
    seconds : that the diagnosis took
    """

    row: str
    number: int
    robot: str
    n_runs: int
    hidden: dict[str, float]
    causes: tuple[str, ...]
    outside: str
    over_limit: float
    classes: dict[str, tuple[str, ...]]
    verdict: str
    named: tuple[str, ...]
    sets: tuple[tuple[str, ...], ...]
    unexplained: tuple[tuple[str, str], ...]
    intervals: dict[str, tuple[float, float, float]]
    gain_low: float
    seconds: float

    def found(self, cause: str) -> bool:
        """Return whether a hidden effect is named, alone or in a set with none but its twins."""
        twins = {cause, *self.classes.get(cause, ())}
        return cause in self.named or any(cause in names and set(names) <= twins for names in self.sets)

    @property
    def right(self) -> bool:
        """Whether all that is hidden is named, and nothing else."""
        return all(self.found(cause) for cause in self.causes) and not self.wrong

    @property
    def wrong(self) -> bool:
        """Whether something is named, alone or in a set, that is not hidden."""
        strangers = [name for name in self.named if name not in self.causes]
        return bool(strangers) or any(not set(names) & set(self.causes) for names in self.sets)


def simulation_of(robot: Robot) -> Simulation:
    """Return the simulation under test, which knows how much runs scatter by themselves."""
    every = load_scatter()
    scatter = {name: getattr(every, name) for name in nuisances_of(robot.drive)}
    return Simulation(robot, Ground(), robot.effects, scatter)


def run_trial(case: Case) -> Trial:
    """Hide, diagnose, compare."""
    robot = load_robot(case.robot)
    key = [case.seed, case.number, ROWS.index(case.row), case.n_runs]
    drawn, noise = np.random.SeedSequence(key).spawn(2)
    rng = np.random.default_rng(drawn)
    rich = rich_drives(rng, case.n_runs)
    drives = poor_drives(rng, case.n_runs) if case.row == "poor" else rich
    limits = None if case.row == "none" else limits_of(robot, rich)
    hidden, causes, over, outside, library = _hidden(case, robot, limits, rng)
    extra = {}
    if outside == "wheel_eccentricity":
        extra = {"wheel_eccentricity_ratio": float(rng.uniform(*ECCENTRICITY_RATIO))}
    elif outside == "stick_slip":
        extra = {"stick_slip_a": float(rng.uniform(*STICK_SLIP_A))}
    runs = hidden_runs(robot, drives, noise, hidden, extra)
    answer: Diagnosis | None
    start_s = time.perf_counter()
    try:
        answer = diagnose(runs, simulation_of(robot), library)
    except DataError:
        answer = None
    seconds = time.perf_counter() - start_s
    classes = {}
    if limits is not None:
        for cause in causes:
            effect = effect_named(cause)
            twins = confusable_class(limits, effect, robot.drive) | {name for name, _ in effect.twins}
            classes[cause] = tuple(sorted(twins))
    return _compared(case, hidden | extra, causes, outside, over, classes, answer, seconds)


def _hidden(
    case: Case, robot: Robot, limits: Limits | None, rng: np.random.Generator
) -> tuple[dict[str, float], tuple[str, ...], float, str, tuple[Effect, ...]]:
    """Draw what is hidden; return it with causes, amplitude over the limit, outside cause and library."""
    library = library_of(robot.drive)
    if limits is None:
        return {}, (), 0.0, "", library
    if case.row == "outside":
        kind = OUTSIDE[(case.number // len(ROBOTS)) % len(OUTSIDE)]
        if kind in [effect.name for effect in library]:
            effect = effect_named(kind)
            over = float(rng.uniform(*ENTRY_TAKEN_OUT))
            rest = tuple(other for other in library if other is not effect)
            return _values(effect, limits, over, rng), (), over, kind, rest
        return {}, (), 0.0, kind, library
    if case.row == "found":
        effect = library[(case.number // len(ROBOTS)) % len(library)]
        over = float(math.exp(rng.uniform(*np.log(FOUND_LADDER))))
        return _values(effect, limits, over, rng), (effect.name,), over, "", library
    effect = library[int(rng.integers(len(library)))]
    over = float(math.exp(rng.uniform(*np.log(LADDER)))) if case.row == "ladder" else STRONG
    hidden = _values(effect, limits, over, rng)
    causes: tuple[str, ...] = (effect.name,)
    if case.row == "two":
        others = [o for o in library if o.name not in confusable_class(limits, effect, robot.drive)]
        others = [o for o in others if o.name not in [name for name, _ in effect.twins]]
        other = others[int(rng.integers(len(others)))]
        hidden |= _values(other, limits, over, rng)
        causes = (effect.name, other.name)
    return hidden, causes, over, "", library


def _values(effect: Effect, limits: Limits, over: float, rng: np.random.Generator) -> dict[str, float]:
    """Return an effect of an amplitude over its limit, either way and in any direction, within its bounds."""
    low = np.array([p.low for p in effect.parameters])
    high = np.array([p.high for p in effect.parameters])
    direction = rng.standard_normal(len(effect.parameters))
    direction /= np.linalg.norm(direction)
    direction = np.where((low == 0.0) & (direction < 0), -direction, direction)
    amplitude = over * limits.of(effect, direction)
    values = np.clip(amplitude * direction, 0.9 * low, 0.9 * high)
    return {p.name: float(value) for p, value in zip(effect.parameters, values, strict=True)}


def _compared(
    case: Case,
    hidden: dict[str, float],
    causes: tuple[str, ...],
    outside: str,
    over: float,
    classes: dict[str, tuple[str, ...]],
    answer: Diagnosis | None,
    seconds: float,
) -> Trial:
    trial = Trial(
        row=case.row,
        number=case.number,
        robot=case.robot,
        n_runs=case.n_runs,
        hidden=hidden,
        causes=causes,
        outside=outside,
        over_limit=over,
        classes=classes,
        verdict=REFUSED,
        named=(),
        sets=(),
        unexplained=(),
        intervals={},
        gain_low=math.nan,
        seconds=seconds,
    )
    if answer is None:
        return trial
    return replace(
        trial,
        verdict=answer.verdict,
        named=tuple(cause.name for cause in answer.causes),
        sets=answer.ambiguous_sets,
        unexplained=tuple((left.channel, left.input) for left in answer.unexplained),
        intervals={
            value.name: (value.value, value.low, value.high)
            for cause in answer.causes
            for value in cause.values
        },
        gain_low=min((cause.gain_low for cause in answer.causes), default=math.nan),
    )


def cases_of(row: str, n: int, seed: int, n_runs: int) -> list[Case]:
    """Return the cases of a row, the robots in turn."""
    return [Case(row, i, ROBOTS[i % len(ROBOTS)], n_runs, seed) for i in range(n)]


def run_trials(cases: Sequence[Case], n_jobs: int = 1, progress: Progress = silent) -> list[Trial]:
    """Return the trials of all cases, in their order."""
    from joblib import Parallel, delayed

    for name in dict.fromkeys(case.robot for case in cases):  # compile once, before workers start
        run_trial(Case("none", 0, name, cases[0].n_runs, cases[0].seed))
    trials: list[Trial] = []
    jobs = (delayed(run_trial)(case) for case in cases)
    results: Iterable[Trial] = Parallel(n_jobs=n_jobs, return_as="generator", batch_size=4)(jobs)
    for trial in results:
        trials.append(trial)
        progress("trials", len(trials), len(cases))
    return trials


class Rate(NamedTuple):
    """How often something was so, and its 95 % interval by Clopper and Pearson."""

    hits: int
    of: int
    rate: float
    low: float
    high: float


def rate_of(outcomes: Iterable[bool]) -> Rate:
    """Return the rate of what is true.

    Examples
    --------
    >>> [round(x, 4) for x in rate_of([False] * 300)[2:]]
    [0.0, 0.0, 0.0122]
    """
    told = [bool(outcome) for outcome in outcomes]
    n, k = len(told), sum(told)
    if n == 0:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low = float(beta.ppf(0.025, k, n - k + 1)) if k > 0 else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return Rate(k, n, k / n, low, high)


def table_of(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the figures of all rows that were tried."""
    rows = {row: [t for t in trials if t.row == row] for row in ROWS}
    table: dict[str, Any] = {}

    def put(name: str, rate: Rate, bar: str, met: bool) -> None:
        if rate.of:
            table[name] = {**rate._asdict(), "bar": bar, "met": met}

    alarms = rate_of(t.verdict not in ("none", "not_excited") for t in rows["none"])
    put("none: false alarms", alarms, "at most 2 %", alarms.rate <= 0.02)
    named = rate_of(all(t.found(c) for c in t.causes) for t in rows["strong"])
    put("strong: named", named, "at least 95 %", named.rate >= 0.95)
    wrong = rate_of(t.wrong for t in rows["strong"])
    put("strong: wrongly named", wrong, "at most 1 %", wrong.rate <= 0.01)
    wrong = rate_of(t.wrong for t in rows["ladder"])
    put("ladder: wrongly named", wrong, "at most 1 %", wrong.rate <= 0.01)
    inside = []
    for t in [*rows["ladder"], *rows["found"], *rows["strong"]]:
        if t.over_limit >= 1.0 and t.causes[0] in t.named:
            inside.append(
                all(t.intervals[p][1] <= value <= t.intervals[p][2] for p, value in t.hidden.items())
            )
    covered = rate_of(inside)
    put(
        "value inside its 95 % interval",
        covered,
        "90 to 99 %, of at least 100",
        covered.of >= 100 and 0.9 <= covered.rate <= 0.99,
    )
    both = rate_of(t.right for t in rows["two"])
    put("two: both, and only both", both, "at least 85 %", both.rate >= 0.85)
    wrong = rate_of(bool(t.named) for t in rows["outside"])
    put("outside: confidently misnamed", wrong, "at most 2 %", wrong.rate <= 0.02)
    left = rate_of(bool(t.unexplained) for t in rows["outside"])
    put("outside: called unexplained", left, "at least 60 %", left.rate >= 0.6)
    for kind in OUTSIDE:
        some = [t for t in rows["outside"] if t.outside == kind]
        put(f"outside, {kind}: misnamed", rate_of(bool(t.named) for t in some), "", True)
        put(f"outside, {kind}: unexplained", rate_of(bool(t.unexplained) for t in some), "", True)
    wrong = rate_of(bool(set(t.named) - set(t.causes)) for t in rows["poor"])
    put("poor: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02)
    unsure = rate_of(t.verdict in (AMBIGUOUS, NOT_EXCITED) for t in rows["poor"])
    put("poor: ambiguous or not excited", unsure, "", True)
    gains = [t.gain_low > 0 for t in trials if t.named]
    gain = rate_of(gains)
    put("held-out gain above zero with its interval", gain, "all", gain.rate == 1.0)
    return table


def found_from(trials: Sequence[Trial]) -> dict[str, dict[str, float]]:
    """Return, by robot and effect, from which amplitude over the limit on nine in ten are found.

    A logistic curve in the logarithm of the amplitude is fitted to what was found and what was not; where all
    are found that were tried, it is the smallest that was tried.
    """
    out: dict[str, dict[str, float]] = {}
    for robot in ROBOTS:
        for effect in library_of("swerve" if robot == "agrimaro" else "skid_steer"):
            some = [t for t in trials if t.row == "found" and t.robot == robot and t.causes == (effect.name,)]
            if len(some) >= FOUND_TRIALS:
                over = np.log([t.over_limit for t in some])
                hit = np.array([t.found(effect.name) for t in some])
                out.setdefault(robot, {})[effect.name] = _ninety(over, hit)
    return out


def _ninety(x: Array, hit: Array) -> float:
    """Return the amplitude at which a logistic curve reaches 0.9; a weak prior keeps it finite."""
    from scipy.optimize import minimize

    def loss(theta: Array) -> float:
        steep = math.exp(min(theta[1], 5.0))
        p = np.clip(1 / (1 + np.exp(-np.clip(steep * (x - theta[0]), -500, 500))), 1e-9, 1 - 1e-9)
        prior = 0.5 * (theta[1] - math.log(6.0)) ** 2 + 0.5 * (theta[0] / 2.0) ** 2
        return float(-(np.log(p[hit]).sum() + np.log(1 - p[~hit]).sum()) + prior)

    theta = minimize(loss, np.array([0.3, math.log(6.0)]), method="Nelder-Mead").x
    return float(math.exp(theta[0] + math.log(9.0) / math.exp(theta[1])))


def as_json(trials: Sequence[Trial]) -> list[dict[str, Any]]:
    """Return every trial as JSON has it; what is not known is null."""
    return [_plain(asdict(t)) for t in trials]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def explain_trials(
    n: int,
    seed: int = 0,
    rows: Sequence[str] = ROWS,
    n_runs: int = 8,
    n_jobs: int = 1,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Run blind trials and return their figures, with every single trial.

    Parameters
    ----------
    n : trials of each row, the robots in turn.  Row ``found`` goes through the effects one after the other,
        and says of an effect from which amplitude on it is found once it had :data:`FOUND_TRIALS` trials
    seed : of all that is drawn; a trial depends on it, its row, its number and ``n_runs`` alone
    rows : of :data:`ROWS`
    n_runs : in each trial
    n_jobs : processes at once

    Returns
    -------
    dict that JSON can hold
        ``n, seed, rows, runs, table, found_from, seconds, trials``.

    Raises
    ------
    ConfigError
        for a row that is unknown or named twice, no row, no trial, or too few runs.
    """
    unknown = [row for row in rows if row not in ROWS]
    if unknown or not rows or len(set(rows)) < len(rows):
        raise ConfigError(f"--rows is {','.join(rows)!r}; some of {','.join(ROWS)} are required, each once")
    if n < 1:
        raise ConfigError(f"--n is {n}; 1 trial of each row at the least is required")
    if n_runs < MIN_RUNS:
        raise ConfigError(f"--runs is {n_runs}; {MIN_RUNS} at the least are required, to hold some out")
    trials = run_trials([case for row in rows for case in cases_of(row, n, seed, n_runs)], n_jobs, progress)
    seconds = [trial.seconds for trial in trials]
    return {
        "n": n,
        "seed": seed,
        "rows": list(rows),
        "runs": n_runs,
        "table": table_of(trials),
        "found_from": found_from(trials),
        "seconds": {"median": float(np.median(seconds)), "worst": max(seconds)},
        "trials": as_json(trials),
    }
