"""Target slips as a table that control reads, learned from runs of any robot; nothing is written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.report import Progress, Report, silent
from pipelines.slip.curves import LearnSlipResult, learn_curves
from pipelines.slip.steady import MeasuredTargets, learn_steady
from terrain.control.slip_table import SlipTable, write_slip_table
from terrain.records import RunLog
from terrain.robots import Robot, SwerveRobot

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False, repr=False)
class LearnedSlipTable(SlipTable):
    """A table of target slips, and what it was learned from.

    Parameters
    ----------
    result : of ``terrain learn-slip``
    """

    result: LearnSlipResult | MeasuredTargets = field(kw_only=True)

    def save(self, path: str | Path) -> Path:
        """Write the table as YAML; return the file."""
        write_slip_table(self, path)
        return Path(path)

    @property
    def report(self) -> Report:
        """What was learned, as the command shows it."""
        return self.result.report

    def to_pandas(self) -> pd.DataFrame:
        """Return a row a terrain and drive state."""
        import pandas as pd

        targets = [target for by_state in self.targets.values() for target in by_state.values()]
        return pd.DataFrame([target._asdict() for target in targets])

    def __repr__(self) -> str:
        return f"<SlipTable {self.name} of {self.robot}: {self.report.answer}>"

    def _repr_html_(self) -> str:
        return self.result._repr_html_()


def learn_slip_table(
    runs: Sequence[RunLog],
    robot: Robot,
    *,
    seed: int = 0,
    name: str = "learned",
    repair: bool = False,
    progress: Progress = silent,
) -> LearnedSlipTable:
    """Learn target slips; nothing is written.

    Parameters
    ----------
    runs : labelled logs: of a swerve robot with motor currents, of others with an outside measurement of
        motion
    robot : whose they are
    seed : of the bootstrap
    name : of the table
    repair : leave out runs that lack something, in place of refusing them
    progress : gets the runs and terrains that are done

    Raises
    ------
    ConfigError
        if the robot lacks a section.
    DataError
        if no run has a label, one is another robot's or lacks currents or attitude, or none has a slip.
    """
    if isinstance(robot, SwerveRobot):
        table, learned = learn_curves(
            runs, robot, seed=seed, name=name, skip_faulty=repair, progress=progress
        )
        return _with_result(table, learned)
    table, measured = learn_steady(runs, robot, seed=seed, name=name, progress=progress)
    return _with_result(table, measured)


def _with_result(table: SlipTable, result: LearnSlipResult | MeasuredTargets) -> LearnedSlipTable:
    return LearnedSlipTable(
        table.name, table.fallback, table.targets, table.robot, table.curves, table.reasons, result=result
    )
