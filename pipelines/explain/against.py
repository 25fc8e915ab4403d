"""What changed between two sets of runs, in a sentence and a table."""

from __future__ import annotations

from collections.abc import Iterator

from pipelines.explain.statements import effect_label
from pipelines.report.numbers import enumerated
from pipelines.report.tree import Column, Part, Table, Text
from terrain.discrepancy.against import Against
from terrain.discrepancy.compared import CHANNEL_WORDS
from terrain.discrepancy.robot_terms import quantity, values_with_intervals
from terrain.robots import Robot


def against_text(against: Against, name: str) -> str:
    """Return what changed from the first set to the set of a name, and what it gains to know it."""
    sentences = []
    for each in against.differences:
        rivals = enumerated([effect_label(rival) for rival in each.rivals], "or")
        sentences.append(
            f"{effect_label(each.name)} by {values_with_intervals(each.parameters)}"
            + (f" (or {rivals}, which these runs do not distinguish from it)" if rivals else "")
        )
    text = f"From these runs to {name} nothing changed that they show."
    if sentences:
        text = f"From these runs to {name} changed: {enumerated(sentences)}."
    if against.candidates:
        names = enumerated([effect_label(each.name) for each in against.candidates])
        text += f" Without a gain on held-out runs that can be claimed, not stated: {names}."
    if against.unnamed:
        channels = enumerated([CHANNEL_WORDS[each.channel][0] for each in against.unnamed])
        text += f" Without a known cause the two{' also' if sentences else ''} differ in {channels}."
    if sentences and against.n_held_out:
        low, high = against.ci
        claim = "removes" if low > 0.0 else "gains nothing that can be claimed:"
        text += (
            f" On {against.n_held_out} held-out runs of both that {claim} {against.reduction:.1%} ({low:.1%} to "
            f"{high:.1%}) of the whitened squared residual."
        )
    if (sentences or against.unnamed) and against.is_one_session_each:
        text += " Each set is of one session: what the session changed is not distinguished from what the set changed."
    return text


def against_parts(against: Against, name: str, robot: Robot) -> Iterator[Part]:
    """Yield the table of what changed, and of the channels that differ without a name."""
    rows = []
    for each in against.differences:
        for k, value in enumerate(each.parameters):
            first = each.first[k].value
            rows.append(
                (
                    *(("", None) if k else (effect_label(each.name), each.z)),
                    quantity(value.name, first),
                    quantity(value.name, first + value.value),
                    values_with_intervals([value]),
                    enumerated([CHANNEL_WORDS[channel][0] for channel in each.channels]),
                    enumerated([effect_label(rival) for rival in each.rivals], "or"),
                )
            )
    note = (
        f"{against.n_runs[0]} and {against.n_runs[1]} runs compared, the causes named above in both. Intervals: 95 %, "
        f"with the scatter between {against.clusters}."
    )
    if rows:
        heads = ("changed", Column("z", ".1f"), "these runs", name, "difference, 95 %", "shows in", "or")
        yield Table(heads, rows, note=note)
    else:
        yield Text(note, "note")
    if against.unnamed:
        left = [
            (CHANNEL_WORDS[u.channel][0], f"depends otherwise on {u.input}", u.z) for u in against.unnamed
        ]
        yield Table(("differs without a name", "its residual", Column("z", ".1f")), left)
    if against.excluded_runs:
        yield Table((f"excluded run of {name}", Column("why", long=True)), against.excluded_runs)
