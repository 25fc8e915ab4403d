"""A robot's description, the odometry of a tracked one, or the soil of a wheel testbed, from logs."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, get_args

from pydantic import Field, field_validator

from pipelines.data.settings import RunsSettings
from pipelines.report.settings import ByCommas, Names, setting
from pipelines.report.settings import Settings as BaseSettings
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.report.results import Progress, Result

EXAMPLE = "terrain calibrate --data raw/ --robot agrimaro --out mine.yaml"
RESULTS = ("pipelines.slip.robot", "pipelines.slip.odometry", "pipelines.slip.soil")
"""Modules of the kinds, with their results."""

Law = Literal["simulator", "bekker", "wong_reece", "ishigami", "ishigami_ding", "ishigami_travel", "inflow"]
"""Laws of a wheel in sand; ``simulator`` is the one of ``terrain simulate``."""

Length = Annotated[float, Field(ge=0.2, le=3600.0)]
"""Seconds of a leg that is compared: the shortest has two poses of a lidar."""


class RobotSettings(BaseSettings):
    """The ground of a robot's runs (--what robot)."""

    hard: Names | None = setting(None)
    """Labels of hard ground, by commas; those that slip next to nothing by default."""


class OdometrySettings(BaseSettings):
    """Odometry of a tracked robot (--what odometry)."""

    lengths: Annotated[tuple[Length, ...], ByCommas] = setting((2.0, 6.0), min_length=1)
    """Seconds after which poses are compared, by commas; windows of DRIVE have their own."""
    folds: int = setting(5, "Folds of whole runs.", ge=2)


class SoilSettings(BaseSettings):
    """Soil of a wheel testbed (--what soil)."""

    laws: Annotated[tuple[Law, ...], ByCommas] = setting(get_args(Law), min_length=1)
    """Laws to compare, by commas; the last one is reported in full."""
    check: Path | None = setting(None)
    """Folder of further trials, which the last law predicts and no fit has."""
    draws: int = setting(60, "Bootstrap samples behind the intervals.", ge=2, le=10_000)
    figures: Path | None = setting(None, "Folder of pictures.")

    @field_validator("laws")
    @classmethod
    def _check_last(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if names[-1] == "simulator":
            raise ValueError("--laws ends in 'simulator'; the last one is a law of stresses, as 'inflow' is")
        return tuple(dict.fromkeys(names))


class Settings(SoilSettings, OdometrySettings, RobotSettings, RunsSettings):
    """What is calibrated, and what is written."""

    what: Literal["robot", "odometry", "soil"] = setting("robot")
    """A robot's description, of any drive, by poses, lidar, satellites or camera; slip-compensated odometry of a
    tracked robot; the soil of a wheel testbed."""
    robot: str | None = setting(None, "Robot by name, or its YAML file, to start from; of a soil none.")
    out: Path | None = setting(None)
    """New YAML file of the robot or of the slip model; of a soil a folder with a file a wheel."""
    seed: int = setting(0, "Of folds and bootstrap; a robot's calibration draws nothing.", ge=0)


GROUPS: dict[str, type[BaseSettings]] = {
    "robot": RobotSettings,
    "odometry": OdometrySettings,
    "soil": SoilSettings,
}


def run(settings: Settings, progress: Progress) -> Result:
    """Calibrate, and write what was found."""
    settings.refuse_others(settings.what, GROUPS, "is for --what {of}, not for --what {mode}")
    if settings.what == "soil":
        settings.refuse(("robot",), "is not for --what soil, whose trials name their wheels")
    elif settings.robot is None:
        raise ConfigError(f"--robot is missing: --what {settings.what} starts from one")
    result: Result = import_module(f"pipelines.slip.{settings.what}").calibrate(settings, progress)
    return result
