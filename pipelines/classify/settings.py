"""Settings of the commands that train and apply classifiers."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import model_validator

from pipelines.crossval.settings import CrossvalSettings, RecipeSettings
from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError


class TrainSettings(RecipeSettings):
    """What is trained, and under which name it is registered."""

    name: str = setting(..., "Name of the registered model.")

    @model_validator(mode="after")
    def _check_name(self) -> Self:
        if not self.name or set(self.name) & set("/:@. "):
            raise ConfigError(
                f"model name {self.name!r}: must not be empty nor hold any of / : @ . and blanks"
            )
        return self

    @property
    def evaluation(self) -> CrossvalSettings:
        """How the recipe is evaluated: on whole held-out runs."""
        return CrossvalSettings(**self.shared(), extras=False)


class ModelSettings(Settings):
    """Whose card is printed."""

    model: str = setting(..., "models:/NAME@champion, models:/NAME/3, or a model folder.", option="MODEL")


class PredictSettings(Settings):
    """Which model predicts, and which table gives the target slips."""

    model: str = setting(..., "models:/NAME@champion, models:/NAME/3, or a model folder.")
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    filter_stride_s: float | None = setting(
        None, "From window to window in s, as the filter of a live chain has them (0.25).", "--filter-stride"
    )
