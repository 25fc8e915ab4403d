"""Runs in Python: read, simulated and explained."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from pipelines.report.numbers import enumerated, plural
from pipelines.report.tree import Column, Report, Table
from terrain.records import RunLog
from terrain.robots import Robot, load_robot

if TYPE_CHECKING:
    import pandas as pd

    from pipelines.explain.explanation import ExplainResult


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

    def __iter__(self) -> Iterator[RunLog]:
        return iter(self._runs)

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


def load_runs(
    folder: str | Path,
    *,
    layout: str = "auto",
    mapping: str | Path | None = None,
    robot: str | Path | None = None,
    repair: bool = False,
    align: bool = False,
) -> Runs:
    """Return the runs that lie under a folder, in any layout that ``terrain convert`` reads.

    Parameters
    ----------
    folder, layout, mapping, robot, repair, align : as :func:`pipelines.data.datasets.load_runs`

    Raises
    ------
    LogError, ConfigError, DataError
        in one sentence, if something cannot be read.
    """
    from pipelines.data.datasets import load_runs as load

    return Runs(load(folder, layout=layout, mapping=mapping, robot=robot, repair=repair, align=align))


def simulate(
    robot: Robot | str | Path,
    terrain: str,
    scenario: str,
    *,
    seed: int = 0,
    number: int = 1,
    duration_s: float | None = None,
    vary: bool = False,
) -> RunLog:
    """Return one simulated run, with the truth beside the measurements.

    Parameters
    ----------
    robot : a description, its name or its YAML file; effects of an extended robot act
    terrain, scenario : as ``terrain simulate`` takes them
    seed, number : of all that is drawn; runs of one seed differ by their number
    duration_s : length in s; that of the scenario by default
    vary : draw soil, slope, load and tyres

    Examples
    --------
    >>> run = simulate("husky", "grass", "straight", duration_s=6.0)
    >>> run.run_id, sorted(run.streams)[:2]
    ('grass_straight_01', ['commands', 'imu'])
    """
    from terrain.simulation.run import simulate_run

    described = load_robot(robot) if isinstance(robot, str | Path) else robot
    return simulate_run(described, terrain, scenario, seed, number, duration_s=duration_s, vary=vary)


def explain(runs: Iterable[RunLog], robot: Robot | str, **options: Any) -> ExplainResult:
    """Return what the simulation of a robot gets wrong about its runs, and the extended robot.

    Parameters
    ----------
    runs, robot, options : as :func:`pipelines.explain.explain.explain_runs`

    Returns
    -------
    ExplainResult
        with ``report``, ``extended`` (the robot with the named causes built in; as it was where none was named)
        and ``to_pandas()``
    """
    from pipelines.explain.explain import explain_runs

    found = explain_runs(list(runs), robot, **options)
    return replace(found, extended=found.extended or found.robot)
