"""Settings of ``terrain label``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Self

from pydantic import model_validator

from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError
from terrain.files.names import plain_name


class LabelSettings(Settings):
    """Whose windows are listed, or where which label is set."""

    data: Path = setting(..., "A run folder, or a folder of run folders.", option="FOLDER")
    run: str | None = setting(None, "Id of the run that is listed or labelled.")
    from_s: float | None = setting(None, "Start of the label in s, on the clock of the run.", option="--from")
    to_s: float | None = setting(None, "End of the label in s.", option="--to")
    whole: bool = setting(False, "Label the whole run.", option="--all")
    terrain: str | None = setting(None, "Terrain that the label names; an empty one removes labels.")
    remove: bool = setting(False, "Remove labels in place of setting one.")
    model: str | None = setting(None, "Model that proposes labels of the runs: as of train, or a folder.")
    ask: int = setting(10, "Questions, the stretches most worth an answer.", ge=0)
    proposals: Path = setting(Path("proposals.csv"), "Table of the proposals, to be answered.")
    answers: Path | None = setting(None, "Table with answers: a terrain, 'yes', or 'none'.")
    out: Path | None = setting(None, "New folder of the runs with their labels.")
    accept: float = setting(0.9, "Confidence from which a proposal needs no answer.", ge=0.0, le=1.01)
    new_class: bool = setting(False, "Accept answers with terrains that are not known yet.")

    @property
    def sets(self) -> bool:
        """Whether labels are changed."""
        return self.remove or self.terrain is not None

    @property
    def new_terrain(self) -> str:
        """Terrain of the label; empty where labels are removed."""
        return "" if self.remove else (self.terrain or "")

    @model_validator(mode="after")
    def _check_proposals(self) -> Self:
        if self.model is not None and (self.answers is not None or self.sets):
            raise ConfigError("--model proposes labels: leave out --answers, --terrain and --remove")
        if (self.answers is None) != (self.out is None):
            raise ConfigError("--answers FILE sets labels in the new folder --out DIR: give both")
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        placed = self.whole or self.from_s is not None or self.to_s is not None
        if placed and not self.sets:
            raise ConfigError("an interval needs --terrain NAME, or --remove")
        if not self.sets:
            return self
        if self.run is None:
            raise ConfigError("a label needs --run ID")
        if self.remove and self.terrain:
            raise ConfigError("--terrain sets a label and --remove removes it: give one of the two")
        if self.terrain and not plain_name(self.terrain):
            raise ConfigError(f"--terrain is {self.terrain!r}: use letters, digits and ' ._+-'")
        if self.whole == (self.from_s is not None and self.to_s is not None):
            raise ConfigError("a label needs --from and --to in s, or --all for the whole run")
        if self.whole and (self.from_s is not None or self.to_s is not None):
            raise ConfigError("--all is the whole run: leave out --from and --to")
        for option, value in (("--from", self.from_s), ("--to", self.to_s)):
            if value is not None and not math.isfinite(value):
                raise ConfigError(f"{option} is {value!r}, a time in s is required")
        if self.from_s is not None and self.to_s is not None and not self.from_s < self.to_s:
            raise ConfigError(
                f"--from is {self.from_s:g} and --to {self.to_s:g}: the label ends before it starts"
            )
        return self
