"""What training and prediction find."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

from pipelines.crossval.results import ChannelImportance, CrossvalReport
from pipelines.learn.tracking import Registered


@dataclass(frozen=True, slots=True)
class Training:
    """A trained and registered model, and the evaluation that it is judged by."""

    registered: Registered
    dataset: str
    data_digest: str
    commit: str
    n_windows: int
    chosen: Mapping[str, Any]
    importance: tuple[ChannelImportance, ...]
    crossval: CrossvalReport
    skipped: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all fields, those of the registered model among them."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        evaluation = replace(self.crossval, dataset=None, data_digest=None, skipped=None)
        document = {**found.pop("registered")._asdict(), **found, "crossval": evaluation}
        return document if self.skipped is not None else {k: v for k, v in document.items() if k != "skipped"}


class WindowPrediction(NamedTuple):
    """The predicted terrain of a window, and the target slips that follow from it.

    Parameters
    ----------
    run_id, start_s : of the window
    terrain : predicted; ``unknown`` where the window is like none that was learned
    probability : of ``nearest``
    target_slip, status : by drive state
    slip_entry : entry of the table of target slips; the fallback where the terrain has none or is unknown
    label : true terrain; None where it is not known
    filtered_terrain : by the windows of the run up to this one; None where none is certain enough
    nearest : the most probable of the learned terrains
    novelty : how unlike all of them the window is; None where the model has no such score
    supported : whether training runs that drove like this support the prediction; None where not counted
    terrain_set : terrains that hold the true one in 90 % of windows; None where not calibrated
    """

    run_id: str
    start_s: float
    terrain: str
    probability: float
    target_slip: Mapping[str, float]
    slip_entry: str
    status: Mapping[str, str]
    label: str | None
    filtered_terrain: str | None = None
    nearest: str = ""
    novelty: float | None = None
    supported: bool | None = None
    terrain_set: tuple[str, ...] | None = None


class TargetSlipRow(NamedTuple):
    """Target slips of a terrain, and the entry of the table that they come from."""

    traction: float
    braking: float
    steady: float
    entry: str
    status: str
    source: str


@dataclass(frozen=True, slots=True)
class Predictions:
    """Predictions of a model for every window that its own rule keeps.

    Parameters
    ----------
    accuracy : of ``nearest`` over the ``n_judged`` windows whose label the model knows; None without any
    training_runs : runs that the model was trained on, whose accuracy does not measure its skill
    repaired : what a repairing reader dropped, as counts by kind
    unknown_labels : windows by labels that the model was not trained on
    dropped : windows left out, as counts by reason
    table : target slips by terrain
    filtered : runs that the live chain filtered, as they had no estimates
    filtered_accuracy : as ``accuracy``, of the terrain filtered over time
    n_unknown : windows that are like no terrain that was learned
    n_unsupported : windows whose prediction no training run supports; None where not counted
    """

    windows: tuple[WindowPrediction, ...]
    n_windows: int
    n_runs: int
    classes: tuple[str, ...]
    accuracy: float | None
    n_judged: int
    training_runs: tuple[str, ...]
    repaired: Mapping[str, int]
    unknown_labels: Mapping[str, int]
    n_unknown_labels: int
    dropped: Mapping[str, int]
    table_name: str
    table: Mapping[str, TargetSlipRow]
    filtered: tuple[str, ...] = ()
    filtered_accuracy: float | None = None
    n_unknown: int = 0
    n_unsupported: int | None = None
    model: str | None = None
    dataset: str | None = None
    skipped: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return all fields without those that the caller did not give."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        unknown = [name for name in ("model", "dataset", "skipped") if found[name] is None]
        return {name: value for name, value in found.items() if name not in unknown}
