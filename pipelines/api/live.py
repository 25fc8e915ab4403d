"""The live chain in Python: an observer of terrain and target slip, and the samples of a log as they would come."""

from __future__ import annotations

from typing import Any

from pipelines.learn.classifier import TerrainClassifier
from pipelines.live import observer
from pipelines.live.model import LiveModel
from terrain.control.slip_table import SlipTable
from terrain.logs.replay import replay
from terrain.robots import Robot

__all__ = ["Observer", "replay"]


class Observer(observer.Observer):
    """The terrain under a robot and its target slips, sample by sample.

    Parameters
    ----------
    model : a fitted classifier, or a model that was loaded
    table : of target slips; the packaged one by default
    robot : its description
    options : as :class:`pipelines.live.observer.Observer`
    """

    def __init__(
        self,
        model: TerrainClassifier | LiveModel,
        table: SlipTable | None = None,
        robot: Robot | None = None,
        **options: Any,
    ) -> None:
        taken = model.model_ if isinstance(model, TerrainClassifier) else model
        super().__init__(taken, table, robot, **options)
