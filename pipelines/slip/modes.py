"""Modes of estimate and calibrate: their options, and the refusal of options of another mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import field_validator

from pipelines.data.settings import RunsSettings
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import option_name, setting
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import ensure_writable

if TYPE_CHECKING:
    from terrain.records import RunLog

Filter = Literal[
    "encoder12",
    "slip14",
    "vio12",
    "vio15",
    "skid",
    "tracked",
    "slip-odometry",
    "slip-learning",
    "encoder-odometry",
    "gyrodometry",
    "endo",
    "sideslip-kinematic",
    "sideslip-dynamic",
    "sideslip-multi",
    "pose",
]
"""Filters, the numbers being those of their states; observers of slip of tracked robots, and of car-like
ones; and ``pose``, slip against an outside measurement of motion."""

Tuning = Literal["physical", "thesis", "likelihood"]
"""Sources of a filter's noise."""


class NoiseSettings(BaseSettings):
    """Noise of filters."""

    tuning: Tuning | None = setting(None, "Noise; the thesis' own for vio12, else physical.")
    tune_on: tuple[str, ...] | None = setting(
        None, "Runs, by commas, for the tuning 'likelihood'; the first three."
    )


class SlipModelSettings(BaseSettings):
    """Slip model of observers."""

    slip_model: Path | None = setting(
        None,
        "Slip model of a tracked robot on its ground, for slip-odometry and endo (terrain calibrate "
        "--what odometry).",
    )


class PoseSettings(BaseSettings):
    """Slip against a pose from outside (--filter pose)."""

    window_s: float = setting(2.0, "Window length in s.", "--window", gt=0.0)
    stride_s: float = setting(1.0, "From window to window in s.", "--stride", gt=0.0)
    delay: str = setting(
        "auto", "Delay of the outside measurement in s; 'auto' finds it, a session at a time."
    )
    predict: bool = setting(False, "Predict slip from currents and wheel speeds, on held-out runs.")
    hold_out: tuple[str, ...] = setting(
        (), "Sessions that predictions never train on, by commas; runs without a label never are."
    )
    rollers: bool = setting(False, "Of omni robots: rollers' friction by surface, load of the wheels.")
    seed: int = setting(0, "Deals and draws runs.", ge=0)

    @field_validator("delay")
    @classmethod
    def _check_delay(cls, text: str) -> str:
        try:
            within = text == "auto" or abs(float(text)) <= 5.0
        except ValueError:
            within = False
        if not within:
            raise ValueError(f"--delay is {text!r}; 'auto' or seconds from -5 to 5 are required")
        return text

    @property
    def delay_s(self) -> float | None:
        """The delay that is given; None where it is to be found."""
        return None if self.delay == "auto" else float(self.delay)


class EstimateOptions(PoseSettings, SlipModelSettings, NoiseSettings):
    """How slip is found."""

    filter: Filter = setting(..., "Filter or observer; 'pose' is slip against a pose from outside.")


LAW_NAMES = (
    "simulator",
    *("bekker", "wong_reece", "ishigami", "ishigami_ding", "ishigami_travel"),
    "inflow",
)
"""Laws of a wheel in sand; ``simulator`` is the one of ``terrain simulate``."""


class RobotSettings(BaseSettings):
    """The ground of a robot's runs (--what robot)."""

    hard: tuple[str, ...] | None = setting(
        None, "Labels of hard ground, by commas; those that slip next to nothing by default."
    )


class OdometrySettings(BaseSettings):
    """Odometry of a tracked robot (--what odometry)."""

    lengths: tuple[float, ...] = setting(
        (2.0, 6.0), "Seconds after which poses are compared, by commas; windows of DRIVE have their own."
    )
    folds: int = setting(5, "Folds of whole runs.", ge=2)


class SoilSettings(BaseSettings):
    """Soil of a wheel testbed (--what soil)."""

    laws: tuple[str, ...] = setting(
        LAW_NAMES, "Laws to compare, by commas; the last one is reported in full."
    )
    check: Path | None = setting(
        None, "Folder of further trials, which the last law predicts and no fit has."
    )
    draws: int = setting(60, "Bootstrap samples behind the intervals.", ge=2, le=10_000)

    @field_validator("laws")
    @classmethod
    def _check_laws(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        unknown = [name for name in names if name not in LAW_NAMES]
        if unknown or not names:
            found = repr(unknown[0]) if unknown else "empty"
            raise ValueError(f"--laws is {found}; choose among {', '.join(LAW_NAMES)}")
        if names[-1] == "simulator":
            raise ValueError("--laws ends in 'simulator'; the last one is a law of stresses, as 'inflow' is")
        return tuple(dict.fromkeys(names))


class CalibrateSettings(SoilSettings, OdometrySettings, RobotSettings, RunsSettings):
    """What is calibrated, and what is written."""

    what: Literal["robot", "odometry", "soil"] = setting(
        "robot",
        "A robot's description; slip-compensated odometry of a tracked robot; the soil of a wheel testbed.",
    )
    robot: str | None = setting(None, "Robot by name, or its YAML file, to start from; of a soil none.")
    out: Path | None = setting(
        None, "New YAML file of the robot or of the slip model; of a soil a folder with a file a wheel."
    )
    figures: Path | None = setting(None, "Folder of pictures; of a soil.")
    seed: int = setting(0, "Of folds and bootstrap; a robot's calibration draws nothing.", ge=0)


def refuse_others(
    settings: BaseSettings, groups: Mapping[str, type[BaseSettings]], used: str, chosen: str
) -> None:
    """Refuse options that a mode does not read.

    Parameters
    ----------
    settings : of the command, which has the fields of all groups
    groups : options, by what they are for
    used : key of the group of the chosen mode
    chosen : the mode, as a sentence names it

    Raises
    ------
    ConfigError
        if an option of another group is set.
    """
    for purpose, group in groups.items():
        for name, field in {} if purpose == used else group.model_fields.items():
            if getattr(settings, name) != field.get_default(call_default_factory=True):
                raise ConfigError(f"{option_name(group, name)} is for {purpose}, not for {chosen}")


def refuse_existing(runs: Sequence[RunLog], out: Path) -> None:
    """Refuse a folder that cannot be written, or that holds a run of the same name.

    Raises
    ------
    LogError
        if it does.
    """
    from terrain.logs.write import run_folder

    ensure_writable(out)
    for run in runs:
        if (folder := run_folder(run.run_id, out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
