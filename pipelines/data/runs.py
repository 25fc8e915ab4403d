"""Run logs in Python: ``terrain.Runs``, and ``terrain.load_runs``, which reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, overload

from pipelines.report.numbers import enumerated, plural
from pipelines.report.tree import Column, Report, Table
from terrain.records import RunLog

if TYPE_CHECKING:
    import pandas as pd


class Runs(Sequence[RunLog]):
    """Run logs, in order of their id.

    Parameters
    ----------
    runs : of one data set

    Examples
    --------
    >>> Runs([RunLog("a", "husky", {}, ((0.0, 9.0, "grass"),))])
    1 run of husky on grass
    """

    def __init__(self, runs: Iterable[RunLog]) -> None:
        self._runs = tuple(runs)

    def __len__(self) -> int:
        return len(self._runs)

    @overload
    def __getitem__(self, index: int) -> RunLog: ...

    @overload
    def __getitem__(self, index: slice) -> Runs: ...

    def __getitem__(self, index: int | slice) -> RunLog | Runs:
        return Runs(self._runs[index]) if isinstance(index, slice) else self._runs[index]

    def select(self, keep: Callable[[RunLog], bool]) -> Runs:
        """Return the runs for which a function is true."""
        return Runs(run for run in self._runs if keep(run))

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a run: id, robot, session, terrains, length in s, and its streams."""
        import pandas as pd

        return pd.DataFrame(
            {
                "run_id": [run.run_id for run in self],
                "robot": [run.robot for run in self],
                "session": [run.session for run in self],
                "terrain": [", ".join(run.terrains) for run in self],
                "duration_s": [run.end_s - run.start_s if run.streams else 0.0 for run in self],
                "streams": [", ".join(run.streams) for run in self],
            }
        )

    def __repr__(self) -> str:
        robots = enumerated(sorted({run.robot for run in self}))
        terrains = enumerated(sorted({name for run in self for name in run.terrains}))
        return f"{plural(len(self), 'run')} of {robots or 'no robot'}" + (
            f" on {terrains}" if terrains else ""
        )

    def _repr_html_(self) -> str:
        table = self.to_pandas()
        rows = [tuple(row) for row in table.itertuples(index=False)]
        columns = [Column(name, ".1f" if name == "duration_s" else "") for name in table.columns]
        return Report("Runs", repr(self), parts=[Table(columns, rows)])._repr_html_()
