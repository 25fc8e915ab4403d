"""Result of ``terrain faults``: a row for each fault, duration, situation and seed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from terrain.control.fault_evaluation import BARS, FaultFigures, Limits


class FaultCase(NamedTuple):
    """A drive with a fault.

    Parameters
    ----------
    fault : its name in the catalogue
    duration_s : for which it acts; infinite for good, None in JSON
    situation, terrain, seed : of the drive
    """

    fault: str
    duration_s: float
    situation: str
    terrain: str
    seed: int


@dataclass(frozen=True, slots=True)
class FaultRow:
    """A drive with a fault, and what it shows.

    Parameters
    ----------
    case : what was driven
    kind, streams, nature : of the fault
    figures : of the drive
    bars : by name, whether it is met; None where it does not apply
    blamed : by the name of a sensor, what the controller's ``health`` named it; None without a ``health``
    exception : the first one that the controller raised, or empty
    """

    case: FaultCase
    kind: str
    streams: tuple[str, ...]
    nature: str
    figures: FaultFigures
    bars: Mapping[str, bool | None]
    blamed: Mapping[str, str] | None
    exception: str

    @property
    def unmet(self) -> tuple[str, ...]:
        """Names of the bars that are not met."""
        return tuple(name for name, met in self.bars.items() if met is False)

    def as_json(self) -> dict[str, Any]:
        """Return the fields in one object, with the verdict; what is infinite is None."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        case, figures = given.pop("case"), given.pop("figures")
        return {**case._asdict(), **given, **figures._asdict(), "is_met": not self.unmet}


@dataclass(frozen=True, slots=True)
class CleanDrive:
    """What the controller does without a fault, and plain commands do, where a situation's rows are compared.

    Parameters
    ----------
    situation, terrain, seed : of the drives
    start_s : when faults begin
    slip_error_ratio : largest error of slip of the controller, from then on
    not_ok_s : time without the status OK from then on while the robot is to move
    slip_peak_ratio, plain_slip_peak_ratio : largest true slip
    stop_m, plain_stop_m : stopping distance; NaN where no stop is commanded
    overspeed_s : longest time for which the commanded speed is above the desired one
    """

    situation: str
    terrain: str
    seed: int
    start_s: float
    slip_error_ratio: float
    not_ok_s: float
    slip_peak_ratio: float
    plain_slip_peak_ratio: float
    stop_m: float
    plain_stop_m: float
    overspeed_s: float


class BarCount(NamedTuple):
    """A bar over all rows: what it asks for, and how many rows meet it, do not, and are not judged by it."""

    text: str
    n_met: int
    n_unmet: int
    n_not_judged: int


@dataclass(frozen=True, slots=True)
class FaultsResult:
    """Sensor faults in the closed loop.

    Parameters
    ----------
    robot, table : that was driven, and its target slips
    seeds : of the drives
    delay_s : from a sample to the wheel
    limits : of the figures
    abouts : what each fault does, by its name
    clean : drives without a fault
    rows : drives with one
    """

    robot: str
    table: str
    seeds: tuple[int, ...]
    delay_s: float
    limits: Limits
    abouts: Mapping[str, str]
    clean: tuple[CleanDrive, ...]
    rows: tuple[FaultRow, ...]

    @property
    def n_met(self) -> int:
        """Number of rows that meet all bars."""
        return sum(not row.unmet for row in self.rows)

    @property
    def bars(self) -> dict[str, BarCount]:
        """Each bar by name, over all rows."""
        from terrain.control.fault_evaluation import bar_texts

        counted = {}
        for name, text in bar_texts(self.limits).items():
            found = [row.bars[name] for row in self.rows]
            counted[name] = BarCount(text, found.count(True), found.count(False), found.count(None))
        return counted

    def as_json(self) -> dict[str, Any]:
        """Return the fields, with the counts by bar."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**given, "bars": self.bars, "n_rows": len(self.rows), "n_met": self.n_met}


def duration_text(duration_s: float) -> str:
    """Return a duration as it is shown.

    Examples
    --------
    >>> duration_text(3.0), duration_text(math.inf)
    ('3 s', 'for good')
    """
    return f"{duration_s:g} s" if math.isfinite(duration_s) else "for good"


SHORT_BARS: Mapping[str, str] = dict(
    zip(BARS, ("ok", "on", "slip", "peak", "stop", "back", "over", "finite"), strict=True)
)
"""Names of the bars in the cells of tables."""
