"""Drive controllers side by side in the closed loop; with --faults through sensor faults; with --path along one."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from pipelines.learn.settings import TrustSettings
from pipelines.report.settings import ByCommas, JobsSettings, Names, setting
from pipelines.report.settings import Settings as BaseSettings
from terrain.control.controllers import CONTROLLERS, KINDS, uses_classifier

if TYPE_CHECKING:
    from pipelines.report.results import Progress, Result

EXAMPLE = "terrain drive --scenario starts --terrain grass --table table.yaml --out drives/"
RESULTS = (
    *("pipelines.drive.comparison", "pipelines.drive.faults", "pipelines.drive.path"),
    "pipelines.drive.follow",
)
"""Modules of the kinds of drive, with their results."""

PAGE_FILE = "report.html"
SITUATIONS = ("start", "stop", "steady")
SlipSourceName = Literal["none", "dynamic", "kinematic", "multi", "multi-grip"]
"""Names of :class:`terrain.control.car_following.SlipSource`, which would load compiled code here."""

ALL = "all"  #: ``--faults`` that names every fault

Ratio = Annotated[float, Field(ge=0.5, le=2.0)]
Duration = Annotated[float, Field(gt=0.0)]


class DrivenSettings(JobsSettings):
    """Robot, terrain and seeds."""

    robot: str = setting("agrimaro", "Robot by name, or its YAML file.")
    terrain: str = setting("grass")
    """Name of a soil, its YAML file, or 'course' for all; with --faults some, by commas; not of car-like robots with
    --path, whose ground has a grip."""
    table: Path | None = setting(None)
    """Table of target slips; by default the packaged one, with --faults one that is learned in simulation."""
    speed_mps: float | None = setting(None, option="--speed", gt=0.0)
    """Cruising speed in m/s; 1 by default, of slower robots 0.6 of the motors; with --path 3 of car-like robots, of
    others at most 0.6 of the motors."""
    seeds: int | None = setting(None, ge=1)
    """Number of seeds: each draws load, soil, tyres and noise; 20 by default, with --faults 1."""
    first_seed: int = setting(0, "First seed.", option="--seed", ge=0)
    out: Path | None = setting(None, "Folder of the page, with --path also of the table of the drive.")


class ComparisonSettings(TrustSettings):
    """Comparison of controllers."""

    scenario: str = setting("starts")
    """starts, straight, slope (the steepest; else level), brake, circle, crab; course and mixed on the terrain
    'course'; or any of simulate."""
    controllers: Names = setting(CONTROLLERS)
    """By commas: plain, ramp, thesis; the traction controller on the target of fallback, classified, true_terrain,
    known:NAME (of that terrain) or target:SLIP; the thesis' PID on the targets of thesis:classified or
    thesis:true_terrain; NAME+track with path tracking."""
    model: str | None = setting(None)
    """Classifier of 'classified' and 'thesis:classified': models:/NAME@champion or a folder; one is trained by
    default."""
    delay_s: float = setting(0.05, "From a sample to the wheel in s.", option="--delay", ge=0.0, le=0.5)
    ramp_mps2: float | None = setting(None, option="--ramp")
    """Rise of speed of 'ramp' in m/s^2; by default the one that travels as far as the traction controller."""
    duration_s: float | None = setting(None, "Length of a drive in s.", option="--duration")
    accel_mps2: float = setting(1.0, "Rise of the desired speed in m/s^2; inf for a step.", option="--accel")
    grade_deg: float = setting(0.0, "Slope in degrees, uphill > 0.", option="--grade", ge=-30.0, le=30.0)
    radius_factors: Annotated[tuple[Ratio, ...], ByCommas] | None = setting(
        None, option="--radius", min_length=3, max_length=3
    )
    """True radius of each wheel over the nominal one, as in 1,1.02,1; drawn by default."""
    leg_backlash_rad: float = setting(0.0, "Backlash of the third leg in rad.", option="--leg-backlash")
    plant: str | None = setting(None, "Robot as it really is, where it differs from --robot.")

    @model_validator(mode="after")
    def _consistent(self) -> ComparisonSettings:
        if self.scenario == "slope" and self.grade_deg:
            raise ValueError("scenario 'slope' searches for the steepest grade itself: leave the grade out")
        if self.model is not None and not self.needs_model:
            names = " and ".join(repr(name) for name in KINDS if uses_classifier(name))
            raise ValueError(f"--model is the classifier of {names}, which are not among the controllers")
        return self

    @property
    def needs_model(self) -> bool:
        """Whether a controller uses a classifier."""
        return any(map(uses_classifier, self.controllers))


class FaultSettings(BaseSettings):
    """Sensor faults in the closed loop (--faults)."""

    faults: Names = setting((), "Drive through these faults: names or kinds of them, by commas, or 'all'.")
    situations: Names = setting(SITUATIONS, f"By commas: {', '.join(SITUATIONS)}.")
    stop_terrains: Names = setting(("wet_floor",), "Soils of stop, by commas.", option="--stop-terrain")
    durations_s: Annotated[tuple[Duration, ...], ByCommas] = setting((3.0, math.inf), option="--durations")
    """For how long a fault acts in s, by commas; inf for good."""
    draw: Names = setting(())
    """Faults whose drives are drawn, by commas; by default, with --out, the worst of each kind."""


class PathSettings(BaseSettings):
    """A robot along a path (--path)."""

    path: Path | None = setting(None)
    """Follow the path of this CSV file: points in their order, columns x_m and y_m, and roll_rad where it is known."""
    observer: SlipSourceName = setting("multi", "What gives the sideslip of a car-like robot.")
    slope_deg: float = setting(0.0, option="--slope", ge=-30.0, le=30.0)
    """Side slope in degrees, left side up > 0; with roll_rad in the file, that; of a car-like robot."""
    grip: float = setting(0.7, "Largest side force over load, of a car-like robot.", gt=0.0, le=1.5)
    offset: float = setting(0.0, "Desired distance to the left of the path in m.", ge=-100.0, le=100.0)
    stop: Annotated[tuple[float, ...], ByCommas] = setting(())
    """Distances in m at which to stop for 3 s, by commas."""
    point_std: float = setting(0.0, ge=0.0, le=10.0)
    """Standard deviation of the points in m: 0.02 for points of an RTK receiver."""

    @field_validator("stop")
    @classmethod
    def _rising_stops(cls, stops: tuple[float, ...]) -> tuple[float, ...]:
        if not all(a < b < math.inf for a, b in zip((0.0, *stops), stops, strict=False)):
            raise ValueError(f"--stop is {','.join(map(str, stops))}; rising distances above 0 are accepted")
        return stops


class Settings(PathSettings, FaultSettings, ComparisonSettings, DrivenSettings):
    """What is driven: a comparison of controllers, sensor faults, or a path."""

    @field_validator("controllers", "situations", "stop_terrains", "durations_s")
    @classmethod
    def _each_once(cls, given: tuple[object, ...], info: ValidationInfo) -> tuple[object, ...]:
        if not given or len(set(given)) < len(given):
            option, text = cls.model_fields[str(info.field_name)].alias, ",".join(map(str, given))
            raise ValueError(f"{option} is {text or 'empty'}; one at least is required, and none twice")
        return given

    @model_validator(mode="after")
    def _one_mode(self) -> Settings:
        """Refuse options that the mode would not use."""
        if self.faults and self.path is not None:
            raise ValueError("--faults and --path are two kinds of drives: give one of them")
        mode = "--path FILE" if self.path is not None else "--faults NAME" if self.faults else ""
        modes: dict[str, type[BaseSettings]] = {"--path FILE": PathSettings, "--faults NAME": FaultSettings}
        if mode:
            also = ("speed_mps",) if self.faults else ("seeds", "n_jobs")
            self.refuse((*ComparisonSettings.model_fields, *also), f"is accepted without {mode.split()[0]}")
        self.refuse_others(mode, modes, "is accepted with {of}")
        return self

    @property
    def all_seeds(self) -> range:
        """Seeds of the drives."""
        n = self.seeds or (1 if self.faults else 20)
        return range(self.first_seed, self.first_seed + n)


def run(settings: Settings, progress: Progress) -> Result:
    """Drive what the settings name, and write the page."""
    from terrain.files.atomic import ensure_writable

    if settings.out is not None:
        ensure_writable(settings.out)
    comparison, faults, path, _ = RESULTS
    mode = path if settings.path is not None else faults if settings.faults else comparison
    result: Result = import_module(mode).run(settings, progress)
    if settings.out is not None:
        result.report.save(settings.out / PAGE_FILE)
    return result
