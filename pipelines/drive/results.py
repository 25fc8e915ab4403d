"""Result of ``terrain drive``: the metrics of each controller over the same seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from pipelines.drive.controller_names import earlier_name
from terrain.control.comparison import MeanInterval

Metrics = Mapping[str, float]
"""Metrics of one drive by name; NaN where one is undefined."""


@dataclass(frozen=True, slots=True)
class DriveResult:
    """Controllers side by side.

    Parameters
    ----------
    scenario, terrain, robot, table : what was driven
    seeds : of the drives
    delay_s : from a sample to the wheel
    grade_deg : of the slope
    ramp_mps2 : of the controller ``ramp``; None where it was not driven
    controllers : by name of the controller and of the metric, its mean over seeds with its 95 % interval
    rows : by name of the controller, the metrics of each seed
    """

    scenario: str
    terrain: str
    robot: str
    table: str
    seeds: tuple[int, ...]
    delay_s: float
    grade_deg: float
    ramp_mps2: float | None
    controllers: Mapping[str, Mapping[str, MeanInterval]]
    rows: Mapping[str, tuple[Metrics, ...]]

    def as_json(self) -> dict[str, Any]:
        """Return the fields; controllers also stand under their names of earlier releases."""
        document = {field.name: getattr(self, field.name) for field in fields(self)}
        for key in ("controllers", "rows"):
            earlier = {earlier_name(name): value for name, value in document[key].items()}
            document[key] = {**document[key], **earlier}
        return document
