"""One spelling for each terrain of a data set: ``Asphalt`` and ``ASPHALT`` are one class to whoever drove.

An accented letter has two forms in Unicode; names that differ in that alone are the same, in form C.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

from terrain.errors import LogError
from terrain.files.names import normal_name, shown
from terrain.records import RunLog

RESPELT = "labels in another spelling of their terrain"


def one_spelling(place: str, runs: Sequence[RunLog], *, repair: bool = False) -> list[RunLog]:
    """Return the runs of a data set, ``place`` in messages, whose terrains differ by more than upper and lower case.

    ``LogError`` where a terrain has two spellings; a repairing read takes that of most runs, the first in the alphabet
    among equals, and counts the labels.

    Examples
    --------
    >>> runs = [RunLog(name, "husky", {}, ((0.0, 1.0, name),)) for name in ("Asphalt", "ASPHALT")]
    >>> one_spelling("logs", runs)
    Traceback (most recent call last):
    terrain.errors.LogError: logs: the terrains 'ASPHALT' and 'Asphalt' differ in upper and lower case ...
    """
    forms: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for run in runs:
        for terrain in run.terrains:
            forms[normal_name(terrain)][terrain] += 1
    spellings: defaultdict[str, Counter[str]] = defaultdict(Counter)
    better: dict[str, str] = {}
    for name, counts in forms.items():
        chosen = next(iter(counts)) if len(counts) == 1 else name
        better |= dict.fromkeys(counts, chosen)
        spellings[name.casefold()][chosen] += counts.total()
    for counts in spellings.values():
        names = sorted(counts, key=lambda name: (-counts[name], name))
        if len(names) > 1 and not repair:
            listed = " and ".join(shown(name) for name in sorted(names))
            raise LogError(
                f"{place}: the terrains {listed} differ in upper and lower case only; name them alike, or "
                "merge them with --repair"
            )
        of_case = dict.fromkeys(names, names[0])
        better = {form: of_case.get(chosen, chosen) for form, chosen in better.items()}
    return [_respelt(run, better) for run in runs]


def _respelt(run: RunLog, better: dict[str, str]) -> RunLog:
    if all(better[terrain] == terrain for terrain in run.terrains):
        return run
    labels = tuple(label._replace(terrain=better[label.terrain]) for label in run.labels)
    n = sum(
        normal_name(old.terrain) != normal_name(new.terrain)
        for old, new in zip(run.labels, labels, strict=True)
    )
    return replace(run, labels=labels, dropped=Counter(run.dropped) + Counter({RESPELT: n}))
