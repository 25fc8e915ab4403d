"""What the support of held-out windows shows."""

from __future__ import annotations

from typing import Any, NamedTuple

from terrain.classify.support_figures import SupportAccuracy


class SupportRow(NamedTuple):
    """A terrain in a regime of driving.

    Parameters
    ----------
    terrain, regime : of the row
    windows, n_runs : in the data, and the runs that they are of
    accuracy : of these windows when held out; None where there are none
    """

    terrain: str
    regime: str
    windows: int
    n_runs: int
    accuracy: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all fields; the terrain is the class."""
        row = self._asdict()
        return {"class": row.pop("terrain"), **row}


class NextDrive(NamedTuple):
    """A drive that is worth recording.

    Parameters
    ----------
    terrain, regime : to be driven
    runs, duration_s : at least so many, each at least so long
    gain : accuracy that these runs are expected to add; it orders the drives, and no more: with cells of
        recorded runs taken away and put back (BorealTC, 35 cells), its rank correlation with the real gain
        was 0.5 and its size far too small
    support_runs : training runs near that motion so far, mean
    windows : of the terrain in the regime so far
    accuracy : of these windows when held out; None where there are none
    """

    terrain: str
    regime: str
    runs: int
    duration_s: float
    gain: float
    support_runs: float
    windows: int
    accuracy: float | None

    def as_json(self) -> dict[str, Any]:
        """Return all fields and the request in words; the terrain is the class."""
        row = self._asdict()
        return {"class": row.pop("terrain"), **row, "request": self.request}

    @property
    def request(self) -> str:
        """The drive in words that an operator can take along."""
        return f"{self.terrain}, {self.regime}, at least {self.runs} runs of {self.duration_s:g} s"


class SupportReport(NamedTuple):
    """Support of held-out windows by the training runs of their folds.

    Parameters
    ----------
    rows : of each terrain in each regime, those without a window among them
    accuracy : by support
    next_drives : best first; empty where the data cannot show what more runs gain
    """

    rows: tuple[SupportRow, ...]
    accuracy: SupportAccuracy
    next_drives: tuple[NextDrive, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the fields under the names that a report gives them."""
        by_level = [
            {"support": level, **part._asdict()} for level, part in self.accuracy.by_true_terrain.items()
        ]
        return {
            "support": self.rows,
            "accuracy_by_support": by_level,
            "unsupported": self.accuracy.unsupported,
            "supported": self.accuracy.supported,
            "supported_auc": self.accuracy.auc,
            "next_drives": self.next_drives,
        }
