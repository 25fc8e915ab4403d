"""Results of ``terrain learn-slip`` by slip that was measured from outside, and their rows as texts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from pipelines.reporting.numbers import format_known
from pipelines.slip.results import TargetRow
from pipelines.slip.transfer import Transfer
from terrain.control.slip_table import DRIVE_STATES
from terrain.measured_slip.surfaces import SurfaceSlip
from terrain.records import TargetStatus

SURFACE_COLUMNS = ("runs", "slip", "95 %", "current A", "thrust/load", *DRIVE_STATES)
TRANSFER_COLUMNS = ("terrain", "learned in", "driven in", "runs", "target", "shown", "off by", "95 %")


class SurfaceTargets(NamedTuple):
    """What was learned of a surface.

    Parameters
    ----------
    slip : as measured
    current_a, thrust_ratio : medians over runs, and their quartiles; NaN where unknown
    targets : by drive state
    reason : why there are no more
    """

    slip: SurfaceSlip
    current_a: tuple[float, float, float]
    thrust_ratio: tuple[float, float, float]
    targets: dict[str, TargetRow]
    reason: str


@dataclass(frozen=True, slots=True)
class MeasuredTargets:
    """Targets of a robot by slip that was measured from outside.

    Parameters
    ----------
    table : file
    robot, dataset, data_digest, seed, window_s : as they are named elsewhere
    n_runs : with a slip, in whatever motion; those of each surface are in steady motion
    surfaces : by name
    transfers : from session to session
    figures : files
    skipped : a sentence for each run that was not used
    """

    table: Path
    robot: str
    dataset: str
    data_digest: str
    seed: int
    window_s: float
    n_runs: int
    surfaces: dict[str, SurfaceTargets]
    transfers: tuple[Transfer, ...]
    figures: tuple[str, ...]
    skipped: tuple[str, ...]


def surface_cells(row: SurfaceTargets) -> tuple[str, ...]:
    """Return the cells of a surface, as screen and page show them; assumed targets have a star."""
    return (
        str(row.slip.n_runs),
        format_known(row.slip.slip_ratio, "{:.3f}"),
        _interval(row.slip.interval, "{:.3f}"),
        format_known(row.current_a[0], "{:.2f}"),
        format_known(row.thrust_ratio[0], "{:.2f}"),
        *(
            f"{target.slip_ratio:+.3f}" + ("" if target.status is TargetStatus.ESTIMATED else "*")
            for target in (row.targets[state] for state in DRIVE_STATES)
        ),
    )


def transfer_cells(each: Transfer) -> tuple[str, ...]:
    """Return the cells of a transfer, as screen and page show them."""
    return (
        each.terrain,
        each.learned or "(none)",
        each.driven or "(none)",
        f"{each.n_learned}, {each.n_driven}",
        f"{each.slip_learned:.3f}",
        f"{each.slip_driven:.3f}",
        f"{each.difference:+.3f}",
        _interval(each.interval, "{:+.3f}"),
    )


def _interval(interval: tuple[float, float], form: str) -> str:
    return f"{format_known(interval[0], form)} to {format_known(interval[1], form)}"
