"""How often answers about foreign worlds came out right, beside the bars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

from studies.blind_trials.scoring import Score, score
from studies.foreign.trial import OVER_LIMIT, ForeignTrial, Outcome

FALSE = (Outcome.WRONG, Outcome.COMPANY, Outcome.VALUE)
HONEST = (Outcome.RIGHT, Outcome.NEAREST, Outcome.SET, Outcome.UNEXPLAINED, Outcome.CANDIDATE)
SEEN = 5.0 / OVER_LIMIT  #: part of the size asked for, from which silence counts


def table_of(trials: Sequence[ForeignTrial]) -> dict[str, Score]:
    """Return the scores of all rows and effects that were tried, by name."""
    return {name: one for name, one in _scores(trials) if one.of}


def _scores(trials: Sequence[ForeignTrial]) -> Iterator[tuple[str, Score]]:
    quiet = [t for t in trials if not t.effect]
    for engine in dict.fromkeys(t.engine for t in trials):
        some = [t for t in trials if t.effect and t.engine == engine]
        if engine == "plain":
            yield "plain: wrong or with false company", score((t.outcome in FALSE for t in some), most=0.03)
            honest = (t.outcome in HONEST for t in some)
            yield "plain: right, nearest, in a set or unexplained", score(honest, least=0.9)
            seen = [t for t in some if t.over_limit >= SEEN * OVER_LIMIT]
            yield (
                "plain: silent at 5 times the limit",
                score((t.outcome is Outcome.SILENT for t in seen), most=0.05),
            )
            for inside in (True, False):
                where = "inside" if inside else "outside"
                own = [t for t in some if t.inside == inside]
                for outcome in Outcome:
                    yield f"plain, {where} the catalogue: {outcome}", score(t.outcome is outcome for t in own)
        for world in dict.fromkeys(t.world for t in some):
            own = [t for t in some if t.world == world]
            named = (Outcome.RIGHT, Outcome.NEAREST, Outcome.SET)
            bars = {"most": 1 / 40, "least": 35 / 40} if engine == "mujoco" else {}
            most = {"most": bars["most"]} if bars else {}
            least = {"least": bars["least"]} if bars else {}
            yield (
                f"{engine}, {world}: wrong or with false company",
                score((t.outcome in FALSE for t in own), **most),
            )
            yield f"{engine}, {world}: named or in a set", score((t.outcome in named for t in own), **least)
    alone = (Outcome.SILENT, Outcome.CANDIDATE, Outcome.OTHER)  # a candidate alone is no statement
    yield "nothing hidden: anything stated", score((t.outcome not in alone for t in quiet), most=0.02)
    yield "nothing hidden: beyond what calibration leaves", score(map(is_news, quiet))
    yield "nothing hidden: a candidate alone", score(t.outcome is Outcome.OTHER for t in quiet)


def is_news(trial: ForeignTrial) -> bool:
    """Return whether runs in which nothing is hidden are answered by more than what calibration leaves."""
    answer = trial.answer
    more = {*answer.unexplained, *answer.learned} - {*trial.known}
    return bool(answer.causes or answer.sets or answer.varying or answer.faults or answer.refusal or more)


def by_effect(trials: Sequence[ForeignTrial]) -> list[tuple[str, str, int, str]]:
    """Return by world and effect how often there was each outcome, in words."""
    groups: dict[tuple[str, str], list[ForeignTrial]] = {}
    for trial in trials:
        groups.setdefault((f"{trial.engine} {trial.world}", trial.effect or "nothing"), []).append(trial)
    rows = []
    for (world, effect), own in groups.items():
        counts = Counter(str(t.outcome) for t in own)
        rows.append((world, effect, len(own), ", ".join(f"{n} {name}" for name, n in counts.most_common())))
    return rows
