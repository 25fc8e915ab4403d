"""Scores of the rows that resemble measured runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

from terrain.discrepancy.trials.known_truth import KNOWN, value_is_right
from terrain.discrepancy.trials.rate import Rate, rate_of
from terrain.discrepancy.trials.rows import Row
from terrain.discrepancy.trials.trial import Trial
from terrain.discrepancy.trials.written_faults import fault_named
from terrain.discrepancy.verdict import Verdict

NAMED_ROWS = (
    *(Row.GROSS, Row.SHORT, Row.LATE, Row.SCATTERED, Row.STALLED, Row.HALF, Row.SENSOR_LATE, Row.DYNAMIC),
)
"""Rows with a bar on right names."""

Scored = tuple[str, Rate, str, bool]
"""Name, rate, bar in words, and whether it is met."""


def measured_scores(rows: Mapping[Row, Sequence[Trial]]) -> Iterator[Scored]:
    """Yield name, rate, bar, and whether it is met."""
    for row in NAMED_ROWS:
        right = rate_of(is_right(t) for t in rows[row])
        yield f"{row.value}: right or its twin set", right, "at least 85 %", right.rate >= 0.85
        wrong = rate_of(bool(wrong_names(t)) for t in rows[row])
        yield f"{row.value}: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02
        yield from _DETAILS.get(row, _nothing)(rows[row])
    stated = rate_of(is_right(t) for t in rows[Row.FAULT])
    yield "fault: stated in words", stated, "at least 95 %", stated.rate >= 0.95
    wrong = rate_of(bool(wrong_names(t)) for t in rows[Row.FAULT])
    yield "fault: a wrong single name", wrong, "at most 2 %", wrong.rate <= 0.02
    for kind in dict.fromkeys(t.fault for t in rows[Row.FAULT]):
        yield (
            f"fault, {kind}: stated",
            rate_of(is_right(t) for t in rows[Row.FAULT] if t.fault == kind),
            "",
            True,
        )
    yield from _known_scores(rows[Row.KNOWN])


def is_right(trial: Trial) -> bool:
    """Return whether an answer is what its row asks for, and names nothing else.

    Row ``fault`` asks for a sentence about the log, row ``half`` for the effect as one that varies, row
    ``stalled`` for the effect and the runs that are stalled, and row ``dynamic`` without an effect for
    silence.
    """
    if trial.row is Row.FAULT:
        return fault_named(trial.fault).stated_in(trial.statements)
    if trial.row is Row.HALF:
        return varies(trial, trial.causes[0]) and not wrong_names(trial)
    if not trial.causes:
        return not states_something(trial)
    right = trial.right and not wrong_names(trial)
    return right and (trial.row is not Row.STALLED or set(trial.stalled) <= set(trial.excluded))


def wrong_names(trial: Trial) -> set[str]:
    """Return what is named alone, or as varying, and is not hidden."""
    varying = {each.name for each in trial.varying if not {*each.rivals} & {*trial.causes}}
    return {*trial.named, *varying} - {*trial.causes, *trial.accepted}


def varies(trial: Trial, cause: str) -> bool:
    """Return whether an effect differs from run to run, alone or with none but its confusable class."""
    twins = {cause, *trial.classes.get(cause, ())}
    return any(
        each.name == cause or (cause in each.rivals and {each.name, *each.rivals} <= twins)
        for each in trial.varying
    )


def states_something(trial: Trial) -> bool:
    """Return whether an answer states that something is wrong."""
    quiet = trial.verdict in (Verdict.NONE, Verdict.NOT_EXCITED)
    return not quiet or bool(trial.statements or trial.varying)


def is_covered(trial: Trial) -> bool:
    """Return whether every hidden value lies within the interval that was given for it."""
    return all(
        name in trial.intervals and trial.intervals[name][1] <= value <= trial.intervals[name][2]
        for name, value in trial.hidden.items()
    )


def groups_are_right(trial: Trial) -> bool:
    """Return whether the runs with the effect are a group of their own."""
    return any(
        {each.name, *each.rivals} & set(trial.causes) and set(ids) == set(trial.present)
        for each in trial.varying
        for _, ids in each.groups
    )


def _nothing(_: Sequence[Trial]) -> Iterator[Scored]:
    yield from ()


def _gross(trials: Sequence[Trial]) -> Iterator[Scored]:
    yield "gross: beyond the bounds, and clipped", rate_of(t.clipped for t in trials), "", True
    found = [t for t in trials if t.causes[0] in t.named]
    yield "gross: value inside its 95 % interval", rate_of(is_covered(t) for t in found), "", True


def _late(trials: Sequence[Trial]) -> Iterator[Scored]:
    for place, name in ((0, "delay"), (1, "effect beside it")):
        yield f"late: {name} found", rate_of(t.found(t.causes[place]) for t in trials), "", True


def _scattered(trials: Sequence[Trial]) -> Iterator[Scored]:
    found = [t for t in trials if t.causes[0] in t.named]
    yield "scattered: mean value inside its 95 % interval", rate_of(is_covered(t) for t in found), "", True


def _stalled(trials: Sequence[Trial]) -> Iterator[Scored]:
    all_out = rate_of(set(t.stalled) <= set(t.excluded) for t in trials)
    yield "stalled: all stalled runs excluded", all_out, "", True
    others = rate_of(bool(set(t.excluded) - set(t.stalled)) for t in trials)
    yield "stalled: another run excluded", others, "", True


def _half(trials: Sequence[Trial]) -> Iterator[Scored]:
    groups = rate_of(groups_are_right(t) for t in trials if varies(t, t.causes[0]))
    yield "half: groups of runs are right", groups, "", True


def _sensor_late(trials: Sequence[Trial]) -> Iterator[Scored]:
    for sensor in dict.fromkeys(t.variant for t in trials):
        found = rate_of(is_right(t) for t in trials if t.variant == sensor)
        yield f"sensor_late, {sensor}: right", found, "", True


def _dynamic(trials: Sequence[Trial]) -> Iterator[Scored]:
    silent = rate_of(states_something(t) for t in trials if not t.causes)
    yield "dynamic, nothing hidden: something stated", silent, "at most 3 of 60", silent.rate <= 3 / 60
    hidden = [t for t in trials if t.causes]
    named = rate_of(t.found(t.causes[0]) for t in hidden)
    yield "dynamic, wheel radius: named or in its set", named, "at least 80 %", named.rate >= 0.8
    covered = rate_of(is_covered(t) for t in hidden if t.found(t.causes[0]))
    yield "dynamic, wheel radius: true value inside", covered, "at least 90 %", covered.rate >= 0.9


_DETAILS: dict[Row, Callable[[Sequence[Trial]], Iterator[Scored]]] = {
    Row.GROSS: _gross,
    Row.LATE: _late,
    Row.SCATTERED: _scattered,
    Row.STALLED: _stalled,
    Row.HALF: _half,
    Row.SENSOR_LATE: _sensor_late,
    Row.DYNAMIC: _dynamic,
}


def _known_scores(trials: Sequence[Trial]) -> Iterator[Scored]:
    for known in KNOWN:
        some = [t for t in trials if t.variant == known.name]
        named = rate_of(t.found(t.causes[0]) and value_is_right(t.intervals) for t in some)
        bar = "at least 90 %"
        yield f"known, {known.name}: named, value within 5 %", named, bar, named.rate >= 0.9
        wrong = rate_of(bool(wrong_names(t)) for t in some)
        yield f"known, {known.name}: a wrong single name", wrong, "at most 1 %", wrong.rate <= 0.01
