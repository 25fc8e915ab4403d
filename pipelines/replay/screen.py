"""What ``terrain replay`` prints: windows as they come, where it is, and a summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipelines.replay.replay import View
from pipelines.replay.results import ObservedWindow, Replay, ReplayedRun, ReplayMoment
from pipelines.reporting.numbers import format_counts, format_known, percent
from pipelines.reporting.terminal import number_columns, print_lines, text_column

REFRESH_S = 0.1
UNKNOWN = "unknown"


class _Lines:
    """A line for each window at which the classified or the believed terrain changes."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._last: tuple[str, str, str] | None = None

    def moment(self, moment: ReplayMoment) -> None:
        pass

    def observed(self, run_id: str, window: ObservedWindow) -> None:
        now = (run_id, window.terrain, window.believed)
        if now != self._last:
            print_lines(self._console, [f"{run_id}  {window_text(window)}"])
        self._last = now


class _LiveLines(_Lines):
    """The same, above a line that says where the replay is."""

    def __init__(self, console: Console, live: Live) -> None:
        super().__init__(console)
        self._live, self._drawn_s = live, 0.0

    def moment(self, moment: ReplayMoment) -> None:
        now_s = perf_counter()
        if now_s - self._drawn_s > REFRESH_S:
            self._drawn_s = now_s
            self._live.update(Text(moment_text(moment)), refresh=True)


@contextmanager
def live_view(console: Console) -> Iterator[View]:
    """Give what shows a replay on a console: with a line that moves where it is a terminal."""
    if not console.is_terminal:
        yield _Lines(console)
        return
    with Live(console=console, auto_refresh=False, transient=True) as live:
        yield _LiveLines(console, live)


def window_text(window: ObservedWindow) -> str:
    """Return a window in a line.

    Examples
    --------
    >>> window_text(ObservedWindow(2.0, 4.0, "grass", 0.83, "", "grass", 0.12, None))
    '4.00 s  grass 83 %  believed grass  target slip 0.120'
    """
    named = f"{window.terrain} {window.probability:.0%}" if window.terrain else "unknown"
    found = f"refused: {window.refused}" if window.refused else named
    return (
        f"{window.end_s:.2f} s  {found.replace('%', ' %')}  believed {window.believed or UNKNOWN}  "
        f"target slip {format_known(window.target_ratio, '{:.3f}')}"
    )


def moment_text(moment: ReplayMoment) -> str:
    """Return where a replay is.

    Examples
    --------
    >>> moment_text(ReplayMoment("field", 3.0, 60.0, "", 0.1))
    'field  3.0 of 60.0 s  believed unknown  target slip 0.100'
    """
    return (
        f"{moment.run_id}  {moment.time_s:.1f} of {moment.duration_s:.1f} s  "
        f"believed {moment.believed or UNKNOWN}  target slip {format_known(moment.target_ratio, '{:.3f}')}"
    )


def print_replay(result: Replay, console: Console) -> None:
    """Print a row for each run, and the sum of all."""
    numbers = number_columns("length s", "windows", "accuracy", "times real time")
    table = Table(text_column("run"), *numbers, text_column("terrain"), text_column("believed"))
    for run in result.runs:
        table.add_row(
            run.run_id,
            f"{run.duration_s:.1f}",
            str(run.n_windows),
            "" if run.accuracy is None else percent(run.accuracy),
            f"{run.times_real_time:.0f}",
            _fractions(run.terrains),
            _fractions(run.believed),
        )
    console.print(table)
    print_lines(console, _summary(result))
    print_lines(console, (line for run in result.runs for line in _notes(run)))
    print_lines(console, (f"note: {sentence}" for sentence in result.skipped))


def _summary(result: Replay) -> Iterator[str]:
    judged = (
        f", accuracy {percent(result.accuracy)} on {result.n_judged} with a label"
        if result.accuracy is not None
        else ""
    )
    yield (
        f"{result.n_windows} windows in {result.duration_s:.1f} s of driving{judged}; "
        f"{result.elapsed_s:.2f} s, {result.times_real_time:.0f} times real time"
    )
    if result.interrupted:
        yield "stopped before the end"


def _notes(run: ReplayedRun) -> Iterator[str]:
    if run.dropped:
        yield f"{run.run_id}: not used {format_counts(run.dropped)}"


def _fractions(found: Mapping[str, float]) -> str:
    return ", ".join(f"{terrain or UNKNOWN} {ratio:.0%}" for terrain, ratio in found.items())
