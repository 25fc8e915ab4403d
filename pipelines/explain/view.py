"""What the page of a diagnosis shows: texts, section by section, that its templates only lay out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from pipelines.reporting.pictures import Image


class FigureView(NamedTuple):
    """A figure with its heading."""

    heading: str
    image: Image


class RunPicture(NamedTuple):
    """Figure of a whole run: title, file beside the page, and the image if the page holds it."""

    title: str
    file: str
    image: Image | None


class VerdictView(NamedTuple):
    """Verdict, gain and warnings, a sentence each."""

    verdict: str
    gain: str
    warnings: tuple[str, ...]


class ValueView(NamedTuple):
    """A parameter with its value."""

    name: str
    value: str
    unit: str
    interval: str


class CauseView(NamedTuple):
    """A cause with its parameters."""

    name: str
    aliases: str
    values: tuple[ValueView, ...]
    terms: str
    caveat: str
    gain: str
    gain_interval: str
    channels: str
    z: str


class AmbiguousView(NamedTuple):
    """An effect of an ambiguous set: its values, and the driving that would show it."""

    name: str
    values: str
    needs: str


class NextDriveView(NamedTuple):
    """The next drive, why it is suggested, and the command that simulates it."""

    drive: str
    reason: str
    command: str


class UnexplainedView(NamedTuple):
    """A channel whose residual depends on an input."""

    channel: str
    input: str
    z: str
    ratio: str


class ChannelGainView(NamedTuple):
    """Residuals of a channel before and after, and what a nameless learner removes of their square."""

    channel: str
    unit: str
    rms_before: str
    rms_after: str
    reduction: str
    interval: str
    remark: str
    learned: str


class GainView(NamedTuple):
    """The gain of all channels, and of each; texts are empty where nothing was built in."""

    text: str
    nameless: str
    channels: tuple[ChannelGainView, ...]
    clusters: str
    n_runs: int
    excluded: str


class ErrorView(NamedTuple):
    """An error of a filter or a classifier before and after."""

    name: str
    unit: str
    before: str
    after: str
    change: str


class ComparisonView(NamedTuple):
    """Errors of a filter or a classifier, or why there are none."""

    title: str
    reason: str
    errors: tuple[ErrorView, ...]


class RuledOutView(NamedTuple):
    """An effect that is not the answer; its value where it was withdrawn."""

    name: str
    value: str
    reason: str
    z: str


class ClockView(NamedTuple):
    """The clock of a run."""

    run: str
    offset: str
    std: str


class Entry(NamedTuple):
    """A name with a text."""

    name: str
    text: str


@dataclass(frozen=True, slots=True)
class PageView:
    """What the page shows, in the order of its sections; a section without content is left out.

    Parameters
    ----------
    heading, lead : of the page
    faults, statements, powertrain : sentences, of channels and of what is between commands and wheels
    verdict : and warnings
    gain : None where nothing is known of runs held out, for ``gain_reason``
    comparisons : of the filter and the classifier
    causes, ambiguous, withdrawn, varying, unexplained, next_drive : sections
    sessions : values of the causes by session, a row of ``SESSION_COLUMNS`` each
    figures, runs : pictures
    ruled_out : effects that runs would have shown
    missed, limits : detection limits of effects that the runs did not excite, and of all others
    excluded, clocks, clocks_text, provenance : of the runs
    """

    heading: str
    lead: str
    faults: tuple[str, ...]
    statements: tuple[str, ...]
    verdict: VerdictView
    gain: GainView | None
    gain_reason: str
    comparisons: tuple[ComparisonView, ...]
    causes: tuple[CauseView, ...]
    ambiguous: tuple[tuple[AmbiguousView, ...], ...]
    withdrawn: tuple[RuledOutView, ...]
    varying: tuple[str, ...]
    unexplained: tuple[UnexplainedView, ...]
    powertrain: tuple[str, ...]
    next_drive: NextDriveView | None
    sessions: tuple[tuple[str, ...], ...]
    figures: tuple[FigureView, ...]
    runs: tuple[RunPicture, ...]
    ruled_out: tuple[RuledOutView, ...]
    missed: tuple[Entry, ...]
    limits: tuple[Entry, ...]
    excluded: tuple[Entry, ...]
    clocks: tuple[ClockView, ...]
    clocks_text: str
    provenance: tuple[Entry, ...]
