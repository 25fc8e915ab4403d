"""Settings of ``terrain drive``."""

from __future__ import annotations

from pathlib import Path

from pydantic import field_validator, model_validator

from pipelines.drive.controller_names import CONTROLLERS, USING_CLASSIFIER, base_name, current_name
from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError

MAX_GRADE_DEG = 30.0
MAX_DELAY_S = 0.5


class DriveSettings(Settings):
    """Robot, scenario, and the controllers that are compared in it."""

    robot: str = setting("agrimaro", "Robot by name, or its YAML file.")
    scenario: str = setting(
        "starts",
        "starts, straight, slope (the steepest; else level), brake, circle, crab; course and mixed on the "
        "terrain 'course'; or any of simulate.",
    )
    terrain: str = setting("grass", "Name of a soil, its YAML file, or 'course' for all.")
    controllers: tuple[str, ...] = setting(
        CONTROLLERS,
        "By commas: plain, ramp, thesis; the traction controller on the target of fallback, classified, "
        "true_terrain, known:NAME (of that terrain) or target:SLIP; the thesis' PID on the targets of "
        "thesis:classified or thesis:true_terrain; NAME+track with path tracking.",
        separated=True,
    )
    table: Path | None = setting(None, "Table of target slips; the packaged one by default.")
    model: str | None = setting(
        None,
        "Classifier of 'classified' and 'thesis:classified': models:/NAME@champion or a folder; one is "
        "trained by default.",
    )
    seeds: int = setting(20, "Number of seeds: each draws load, soil, tyres and noise.", ge=1)
    first_seed: int = setting(0, "First seed.", option="--seed", ge=0)
    delay_s: float = setting(0.05, "From a sample to the wheel in s.", option="--delay")
    ramp_mps2: float | None = setting(
        None,
        "Rise of speed of 'ramp' in m/s^2; by default the one that travels as far as the traction "
        "controller.",
        option="--ramp",
    )
    duration_s: float | None = setting(None, "Length of a drive in s.", option="--duration")
    speed_mps: float = setting(1.0, "Cruising speed in m/s.", option="--speed")
    accel_mps2: float = setting(1.0, "Rise of the desired speed in m/s^2; inf for a step.", option="--accel")
    grade_deg: float = setting(0.0, "Slope in degrees, uphill > 0.", option="--grade")
    radius_factors: tuple[float, float, float] | None = setting(
        None,
        "True radius of each wheel over the nominal one, as in 1,1.02,1; drawn by default.",
        option="--radius",
        separated=True,
    )
    leg_backlash_rad: float = setting(
        0.0, "Backlash of the third leg in rad.", option="--leg-backlash", aliases=("--leg-play",)
    )
    plant: str | None = setting(None, "Robot as it really is, where it differs from --robot.")
    out: Path | None = setting(None, "Folder of the page with its pictures.")
    jobs: int = setting(0, "Processes at once; 0 for one a core.", ge=0)

    @field_validator("controllers")
    @classmethod
    def _named_once(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        current = tuple(current_name(name) for name in names)
        if not current:
            raise ConfigError("no controller is named")
        repeated = {name for name in current if current.count(name) > 1}
        if repeated:
            raise ConfigError(f"controllers name {min(repeated)!r} twice")
        return current

    @field_validator("delay_s")
    @classmethod
    def _possible_delay(cls, delay_s: float) -> float:
        if not 0.0 <= delay_s <= MAX_DELAY_S:
            raise ConfigError(f"--delay is {delay_s!r}; 0 to {MAX_DELAY_S:g} s are accepted")
        return delay_s

    @field_validator("grade_deg")
    @classmethod
    def _possible_grade(cls, grade_deg: float) -> float:
        if not abs(grade_deg) <= MAX_GRADE_DEG:
            limits = f"{-MAX_GRADE_DEG:g} to {MAX_GRADE_DEG:g} degrees"
            raise ConfigError(f"--grade is {grade_deg:g}; {limits} are accepted")
        return grade_deg

    @field_validator("radius_factors", mode="before")
    @classmethod
    def _three_ratios(cls, given: object) -> tuple[float, ...] | None:
        if given is None:
            return None
        try:
            ratios = tuple(float(part) for part in given)  # type: ignore[attr-defined]
        except (TypeError, ValueError):
            ratios = ()
        if len(ratios) != 3 or not all(0.5 <= ratio <= 2.0 for ratio in ratios):
            text = ",".join(map(str, given)) if isinstance(given, tuple) else given
            raise ConfigError(
                f"--radius is {text!r}; three ratios from 0.5 to 2 are required, as in 1,1.02,1"
            )
        return ratios

    @model_validator(mode="after")
    def _consistent(self) -> DriveSettings:
        if self.scenario == "slope" and self.grade_deg:
            raise ConfigError("scenario 'slope' searches for the steepest grade itself: leave the grade out")
        if self.model is not None and not self.needs_model:
            names = " and ".join(map(repr, USING_CLASSIFIER))
            raise ConfigError(f"--model is the classifier of {names}, which are not among the controllers")
        return self

    @property
    def needs_model(self) -> bool:
        """Whether a controller uses a classifier."""
        return any(base_name(name) in USING_CLASSIFIER for name in self.controllers)

    @property
    def n_jobs(self) -> int:
        """Number of processes."""
        import os

        return self.jobs or os.cpu_count() or 1
