"""What a comparison of two classifiers finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from terrain.classify.paired import Comparison, Difference


@dataclass(frozen=True, slots=True)
class CompareReport:
    """Differences between two recipes on the same folds, or two models on the same runs.

    Parameters
    ----------
    a, b : as named by the user
    kind : ``recipes`` or ``models``
    comparison : figures of both, with differences of b minus a
    by_support : differences of accuracy by how many training runs drove the true terrain with the motion of a
        window; empty of models, and where the motion is not known
    n_runs, n_windows, repeats : that the figures are over; windows of a
    excluded_runs : of which one of the models was trained on
    notes : what a reader has to know
    """

    dataset: str
    data_digest: str
    a: str
    b: str
    kind: str
    comparison: Comparison
    n_runs: int
    n_windows: int
    repeats: int
    by_support: Mapping[str, Difference] = field(default_factory=dict)
    excluded_runs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return all fields, those of the comparison among them."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**found, **found.pop("comparison")._asdict()}
