"""One trial: a builder calibrates a robot's description by ``terrain explain``, something changes, and it is asked for.

Whatever the world does otherwise than the nominal description is in the extended one before anything is hidden.  What
that one still leaves unexplained where nothing is hidden is known to its builder: it is no answer to what is hidden,
but that a channel depends on something else than it did is.
Where nothing is hidden it counts as stated all the same, and what is new beside it is counted apart.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np

from pipelines.explain.explain import explain
from studies.foreign.worlds import WORLDS, World, driven_by, effect_of, effects_of, runs_of
from terrain.discrepancy.diagnose import POWER_Z
from terrain.discrepancy.evidence import Z_EFFECT, Evidence, evidence_at, marginal
from terrain.discrepancy.health.fault import Column, FaultKind
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.runs import Simulation, low_pass_of, signals_of
from terrain.discrepancy.search import names_of
from terrain.discrepancy.verdict import Tier
from terrain.effects import PARAMETER, library_of, parameters_of
from terrain.errors import DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.records import RunLog
from terrain.robots import Robot, load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers

N_RUNS = 12  #: of a trial
#: Runs that the description is calibrated on, a quarter of an hour: with fewer what is true of a world may stay a
#: candidate, and is then news in every trial.
N_CALIBRATION = 60
MAX_PASSES = 3  #: of the calibration: a builder explains again what an extended description leaves
OVER_LIMIT = 6.0  #: size of an effect over its detection limit
CLOSE = 0.15  #: by which that may be missed
N_PROBED = 4  #: runs that sizes are found by
LEAST = 0.02  #: part of the largest size that is hidden at the least
VALUE_RATIO = 0.2  #: by which a stated value may miss the hidden one, where its interval does not hold that

Stated = tuple[float, float, float]  #: a value and its 95 % interval


class Outcome(StrEnum):
    """What an answer is worth, by the physics of what is hidden.

    A candidate is honest where it is what is hidden, or comes nearest: the page lists it first for the channel.  Any
    other candidate is no false name, and no answer either.  Of what comes nearest, and of the members of a set, values
    are not compared, for what is hidden has another law, or none of them is stated.
    """

    RIGHT = "right"  #: the effect is named with its value, and nothing else
    NEAREST = "nearest"  #: what comes nearest is named, and nothing else
    SET = "set"  #: a set of names holds one of these
    UNEXPLAINED = (
        "unexplained"  #: nothing is named, and a channel is unexplained or a term is learned that was not
    )
    CANDIDATE = "candidate"  #: nothing but candidates, the effect or what comes nearest among them
    OTHER = "other candidate"  #: nothing but candidates, none of which is
    VALUE = "wrong value"  #: the effect is named, and nothing else, but its value is not right
    COMPANY = "company"  #: something that is not there is named beside it
    WRONG = "wrong"  #: something that is not there is named
    SILENT = "silent"


class Answer(NamedTuple):
    """What ``terrain explain`` states."""

    named: Mapping[
        str, Stated
    ] = {}  #: by parameter, of what is built in; of one that varies mean and scatter
    causes: tuple[str, ...] = ()
    sets: tuple[tuple[str, ...], ...] = ()
    varying: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()  #: sentences
    candidates: tuple[str, ...] = ()
    unexplained: tuple[str, ...] = ()  #: channels, with the input that each depends on where one is stated
    learned: tuple[str, ...] = ()  #: channels of learned terms that are new
    refusal: str = ""


@dataclass(frozen=True, slots=True)
class ForeignTrial:
    """What was hidden in a world, and what was answered."""

    row: str
    number: int
    engine: str  #: plain or mujoco
    world: str
    effect: str  #: name of what is hidden; empty for nothing
    size: float
    over_limit: float  #: its size over the detection limit in these runs
    inside: bool  #: whether the catalogue has it
    right: tuple[str, ...]
    nearest: tuple[str, ...]
    hidden: Mapping[
        str, float
    ]  #: values by parameter, beside the calibrated description, where the catalogue has them
    known: tuple[str, ...]  #: what the calibrated description leaves: channels with inputs, candidates
    answer: Answer
    outcome: Outcome
    seconds: float


def value_is_right(stated: Mapping[str, Stated], hidden: Mapping[str, float]) -> bool:
    """Return whether stated values hold those that are hidden within their intervals, or miss them by little.

    Examples
    --------
    >>> stated = {"gyro_scale_ratio": (0.03, 0.02, 0.04)}
    >>> [value_is_right(stated, {"gyro_scale_ratio": value}) for value in (0.021, 0.036, 0.05)]
    [True, True, False]
    """
    near = VALUE_RATIO * max(map(abs, hidden.values()), default=0.0)
    return all(
        name in stated
        and (stated[name][1] <= value <= stated[name][2] or abs(stated[name][0] - value) <= near)
        for name, value in hidden.items()
    )


def outcome_of(
    answer: Answer,
    right: Sequence[str],
    nearest: Sequence[str],
    known: Sequence[str],
    hidden: Mapping[str, float] | None = None,
) -> Outcome:
    """Return what an answer is worth, where what is ``known`` is no answer.

    Examples
    --------
    >>> outcome_of(Answer(causes=("payload", "scrub")), ("payload",), (), ())
    <Outcome.COMPANY: 'company'>
    >>> outcome_of(Answer(unexplained=("current_a by speed",)), ("payload",), (), ("current_a by speed",))
    <Outcome.SILENT: 'silent'>
    """
    good = {*right, *nearest}
    single = {*answer.causes, *answer.varying}
    sets = [names for names in answer.sets if good & {*names}]
    if single - good or len(sets) < len(answer.sets) or answer.faults or answer.refusal:
        return Outcome.COMPANY if single & good or sets else Outcome.WRONG
    if single & {*right}:
        return Outcome.RIGHT if value_is_right(answer.named, hidden or {}) else Outcome.VALUE
    if single:
        return Outcome.NEAREST
    if sets:
        return Outcome.SET
    if {*answer.unexplained, *answer.learned} - {*known}:
        return Outcome.UNEXPLAINED
    if candidates := {*answer.candidates} - {*known}:
        return Outcome.CANDIDATE if candidates & good else Outcome.OTHER
    return Outcome.SILENT


class Examined(NamedTuple):
    """A world with the description that its builder has calibrated, and what that leaves unexplained."""

    world: World
    robot: Robot
    known: tuple[str, ...]
    noise: Noise


def asked(runs: Sequence[RunLog], robot: Robot) -> tuple[Answer, Robot]:
    """Return what ``terrain explain`` answers, and the extended robot."""
    try:
        found = explain(runs, robot)
    except DataError as error:
        return Answer(refusal=str(error)), robot
    diagnosis: Any = found.diagnosis
    # a scale beyond that of any sensor is stated as a fault of the logs
    scales = [each for each in diagnosis.faults if each.change[:2] == (FaultKind.SCALE, Column.GYRO)]
    scale = {"gyro_scale_ratio": (1.0 / scales[0].change.factor - 1.0,) * 3} if scales else {}
    terms = found.extended.learned[len(robot.learned) :]
    return Answer(
        named={
            **{
                e.parameter: (e.mean, e.mean - 2.0 * e.scatter, e.mean + 2.0 * e.scatter)
                for e in diagnosis.varying
            },
            **{v.name: (v.value, v.low, v.high) for cause in diagnosis.built_in for v in cause.parameters},
            **scale,
        },
        causes=(*(cause.name for cause in diagnosis.causes), *["gyro_scale"] * len(scale)),
        sets=diagnosis.ambiguous_sets,
        varying=tuple(each.name for each in diagnosis.varying),
        faults=tuple(fault.sentence for fault in diagnosis.faults if fault not in scales),
        candidates=tuple(cause.name for cause in diagnosis.candidates),
        unexplained=(
            *(f"{each.channel} by {each.input}" for each in diagnosis.unexplained),
            *(
                each.channel
                for each in diagnosis.channels
                if each.tier is Tier.UNEXPLAINED
                and each.channel not in {left.channel for left in diagnosis.unexplained}
            ),
        ),
        learned=tuple(term.channel for term in terms),
    ), found.extended


@cache
def examined(engine: str, name: str, seed: int) -> Examined:
    """Return a world, and what its builder makes of its description by runs in which nothing is hidden."""
    world = WORLDS[engine, name]()
    robot, key = load_robot(world.robot), [seed, *engine.encode(), *name.encode()]
    rng = np.random.default_rng(key)
    for child in np.random.SeedSequence(key).spawn(MAX_PASSES):
        runs = runs_of(world, driven_by(world, N_CALIBRATION, rng), child)
        answer, extended = asked(runs, robot)
        if extended.effects == robot.effects and len(extended.learned) == len(robot.learned):
            break
        robot = extended
    known = tuple(sorted({*answer.unexplained, *answer.learned, *answer.candidates}))
    return Examined(world, robot, known, evidence_of(runs, robot).noise)


# -- How large something is over what runs could show of it ------------------------------------------------


def evidence_of(runs: Sequence[RunLog], robot: Robot, noise: Noise | None = None) -> Evidence:
    """Return the evidence of runs beside a simulation; with noise that is known, of what differs by run alone."""
    signals = [signals_of(with_wheel_speeds(run, robot), robot) for run in runs]
    simulation = Simulation(robot, Ground(), robot.effects, spread_numbers("scatter"), learned=robot.learned)
    names = names_of(library_of(robot.drive)) if noise is None else ()
    return evidence_at(signals, simulation, simulation.vector, names, low_pass_of(signals), noise)


def over_limit(plain: Evidence, hidden: Evidence, n_runs: int) -> float:
    """Return the size of what is hidden in runs over the detection limit of so many, from the same runs without it.

    It is the root of the whitened square of what it changes, less what differs from run to run anyway, over that which
    a test of one effect has to have nine times in ten.
    """
    square, random = 0.0, range(len(plain.nuisances))
    for one, other in zip(plain.white, hidden.white, strict=True):
        rows = min(one.shape[1], other.shape[1])
        change = (other[-1, :rows] - one[-1, :rows])[None]
        columns = np.concatenate([one[plain.nuisances, :rows], change]).reshape(len(random) + 1, -1)
        gram = (columns @ columns.T)[None, None]
        square += float(marginal(gram, random, plain.nuisance_std)[0][0, -1, -1])
    return math.sqrt(max(square, 0.0) * n_runs / len(plain.white)) / (Z_EFFECT + POWER_Z)


@cache
def sized(engine: str, world: str, seed: int, name: str) -> tuple[float, float]:
    """Return the size of an effect of :data:`OVER_LIMIT` times its limit, or its largest, and its size over the limit.

    By secants: what some effects change is not proportional to their size.
    """
    base, effect = examined(engine, world, seed), effect_of(engine, world, name)
    driven = driven_by(base.world, N_PROBED, np.random.default_rng([seed, 1]))

    def evidence(shown: World) -> Evidence:
        runs = runs_of(shown, driven, np.random.SeedSequence([seed, 2]))
        return evidence_of(runs, base.robot, base.noise)

    plain, size = evidence(base.world), 0.3 * effect.most
    for _ in range(3):
        over = over_limit(plain, evidence(effect.hide(base.world, size)), N_RUNS)
        if abs(over / OVER_LIMIT - 1.0) < CLOSE or (size == effect.most and over < OVER_LIMIT):
            break
        size = min(max(size * OVER_LIMIT / max(over, 1e-3), LEAST * effect.most), effect.most)
    return size, over


# -- Trials ------------------------------------------------------------------------------------------------

ROWS = (*(f"{engine}_{world}" for engine, world in WORLDS), "nothing")


class Case(NamedTuple):
    """One trial to be done: its row and number, the world, what is hidden (empty for nothing), and the seed of all."""

    row: str
    number: int
    engine: str
    world: str
    effect: str
    seed: int


def cases_of(row: str, n: int, seed: int) -> list[Case]:
    """Return ``n`` cases of a row: what the catalogue has and what it lacks in turn, or nothing in worlds in turn.

    In scenes of MuJoCo each effect has its turn.
    """
    if row == "nothing":
        places = [place for place in WORLDS if place[0] == "plain" or find_spec("mujoco")]
        return [Case(row, i, *places[i % len(places)], "", seed) for i in range(n)]
    engine, world = row.split("_")
    drive = load_robot(WORLDS[engine, world]().robot).drive
    names = {each.name for each in library_of(drive)}
    effects = effects_of(engine, world)
    kinds = [[e.name for e in effects if bool({*e.right} & names) == inside] for inside in (True, False)]
    if engine == "mujoco":  # hardly any is outside: all in turn
        kinds = [[effect.name for effect in effects]]
    kinds = [kind for kind in kinds if kind]
    turns = [kinds[i % len(kinds)] for i in range(n)]
    return [
        Case(row, i, engine, world, kind[i // len(kinds) % len(kind)], seed) for i, kind in enumerate(turns)
    ]


def run_case(case: Case) -> ForeignTrial:
    """Hide an effect, or nothing, in runs of a world, and ask for it."""
    base, start_s = examined(case.engine, case.world, case.seed), time.perf_counter()
    key = [case.seed, case.number, *case.row.encode(), *case.world.encode()]
    rng, shown, size, over = np.random.default_rng(key), base.world, 0.0, 0.0
    right: tuple[str, ...] = ()
    nearest: tuple[str, ...] = ()
    hidden: dict[str, float] = {}
    if case.effect:
        effect = effect_of(case.engine, case.world, case.effect)
        right, nearest = effect.right, effect.nearest
        size, over = sized(case.engine, case.world, case.seed, case.effect)
        size *= float(rng.choice([-1.0, 1.0])) if effect.signed else 1.0
        shown = effect.hide(base.world, size)
        given = base.robot.effects  # a ratio is of what was calibrated
        hidden = {
            name: value * (1.0 + (given.get(name, 0.0) if PARAMETER[name].as_percent else 0.0))
            for name, value in effect.values(base.world, size).items()
            if name in parameters_of(base.robot.drive)
        }
    runs = runs_of(shown, driven_by(base.world, N_RUNS, rng), np.random.SeedSequence(key))
    answer, _ = asked(runs, base.robot)
    return ForeignTrial(
        row=case.row,
        number=case.number,
        engine=case.engine,
        world=case.world,
        effect=case.effect,
        size=size,
        over_limit=over,
        inside=bool({*right} & {each.name for each in library_of(base.robot.drive)}),
        right=right,
        nearest=nearest,
        hidden=hidden,
        known=base.known,
        answer=answer,
        outcome=outcome_of(answer, right, nearest, base.known if case.effect else (), hidden),
        seconds=time.perf_counter() - start_s,
    )
