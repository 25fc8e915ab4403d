"""Settings of ``terrain faults``."""

from __future__ import annotations

import math
from pathlib import Path

from pydantic import field_validator

from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError


class FaultsSettings(Settings):
    """Robot, faults, and the situations in which they begin."""

    robot: str = setting("agrimaro", "Robot by name, or its YAML file.")
    faults: tuple[str, ...] = setting(
        (), "Names of faults, or of kinds of them, by commas; all by default.", separated=True
    )
    situations: tuple[str, ...] = setting(
        ("start", "stop", "steady"), "By commas: start, stop, steady.", separated=True
    )
    terrains: tuple[str, ...] = setting(
        ("grass",), "Soils of start and steady, by commas.", option="--terrain", separated=True
    )
    stop_terrains: tuple[str, ...] = setting(
        ("wet_floor",), "Soils of stop, by commas.", option="--stop-terrain", separated=True
    )
    durations_s: tuple[float, ...] = setting(
        (3.0, math.inf),
        "For how long a fault acts in s, by commas; inf for good.",
        option="--durations",
        separated=True,
    )
    table: Path | None = setting(
        None, "Table of target slips; one is learned from simulated runs by default."
    )
    seeds: int = setting(1, "Number of seeds: each draws load, soil, tyres and noise.", ge=1)
    first_seed: int = setting(0, "First seed.", option="--seed", ge=0)
    draw: tuple[str, ...] = setting(
        (),
        "Faults whose drives are drawn on the page, by commas; by default the worst of each kind.",
        separated=True,
    )
    out: Path | None = setting(None, "Folder of the page with its pictures.")
    jobs: int = setting(0, "Processes at once; 0 for one a core.", ge=0)

    @field_validator("situations", "terrains", "stop_terrains", "durations_s")
    @classmethod
    def _named_once(cls, given: tuple[object, ...]) -> tuple[object, ...]:
        if not given:
            raise ConfigError("situations, terrains and durations: one of each at least is required")
        if len(set(given)) < len(given):
            raise ConfigError(f"{', '.join(map(str, given))}: one is named twice")
        return given

    @field_validator("durations_s")
    @classmethod
    def _possible_durations(cls, durations_s: tuple[float, ...]) -> tuple[float, ...]:
        for duration_s in durations_s:
            if not duration_s > 0.0:
                raise ConfigError(f"--durations has {duration_s:g}; times above 0 s are accepted, or inf")
        return durations_s

    @property
    def n_jobs(self) -> int:
        """Number of processes."""
        import os

        return self.jobs or os.cpu_count() or 1
