"""What ``terrain quickstart`` finds."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pipelines.crossval.results import CrossvalReport
from pipelines.data.convert import ImportResult
from pipelines.estimate.consistency import TerrainConsistency
from pipelines.learn.predict import Predictions
from pipelines.learn.train import TrainResult
from terrain.estimation.labelled import TerrainSlip


@dataclass(frozen=True, slots=True)
class KeptRuns:
    """Where the runs lie, and whether they were there from an earlier call.

    ``imported`` is the result of reading them, where they come from a folder of the user.
    """

    out: Path
    n_runs: int
    reused: bool
    imported: ImportResult | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all fields, those of the import among them."""
        found = {"out": self.out, "n_runs": self.n_runs, "reused": self.reused}
        if self.imported is None:
            return found
        return {each.name: getattr(self.imported, each.name) for each in fields(self.imported)} | found


@dataclass(frozen=True, slots=True)
class QuickstartResult:
    """Evaluation, model and predictions, and where they come from.

    Parameters
    ----------
    slip : estimated and true slip by terrain; None where the runs are the user's
    consistency : of the filter by terrain and group of states; None where the runs are the user's
    commands : what to type for the same, step by step
    report : file of the page
    created, elapsed_s : when the work was done, and how long it took
    held_out : runs that are predicted and that the model was neither evaluated nor trained on; none where the
        runs were too few
    """

    dataset: str
    data_digest: str
    commit: str
    seed: int
    crossval: CrossvalReport
    train: TrainResult
    predict: Predictions
    imported: KeptRuns
    slip: tuple[TerrainSlip, ...] | None
    consistency: tuple[TerrainConsistency, ...] | None
    commands: tuple[str, ...]
    report: Path
    created: str
    elapsed_s: float
    held_out: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return all fields; the evaluation is given once, beside the training."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        training = self.train.as_json()
        del training["crossval"]
        return found | {"train": training}
