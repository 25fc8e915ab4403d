"""``terrain simulate``: seeded run folders of a simulated robot, the truth beside the measurements."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipelines.reporting.progress import Progress, silent
from pipelines.runs.settings import SimulateSettings
from terrain.effects import read_effect
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import ensure_writable
from terrain.logs.write import run_folder, write_run
from terrain.robots import load_robot
from terrain.simulation.conditions import Conditions, Faults
from terrain.simulation.run import BENCH_TERRAIN, COURSE, run_id_of, simulate_run
from terrain.simulation.sensors.gnss import Gnss
from terrain.terramechanics.soil import load_soil, soil_names

EVERY = "all"
"""Given in place of a terrain: each soil in turn."""


@dataclass(frozen=True, slots=True)
class SimulatedRuns:
    """Run folders that were simulated.

    Parameters
    ----------
    out : folder of the run folders
    robot, scenario, seed : of the runs
    effects : parameters of :mod:`terrain.effects.catalogue` that act
    n_runs, run_ids : how many, and their names
    duration_s : of all runs together
    """

    out: Path
    robot: str
    scenario: str
    seed: int
    effects: Mapping[str, float]
    n_runs: int
    run_ids: tuple[str, ...]
    duration_s: float


def simulate_runs(settings: SimulateSettings, progress: Progress = silent) -> SimulatedRuns:
    """Simulate runs and write them as run folders.

    Raises
    ------
    ConfigError
        if a setting is not accepted.
    LogError
        if a run of that name exists already; nothing is written then.
    """
    scenario, out = settings.scenario, settings.out
    robot = load_robot(settings.robot)
    effects = _effects(settings.effect, robot.drive)
    ensure_writable(out)
    terrains = soil_names() if settings.terrain == EVERY else (settings.terrain,)
    jobs = [(name, number) for name in terrains for number in range(1, settings.runs + 1)]
    for name, number in jobs:
        terrain = name if name in (COURSE, BENCH_TERRAIN) else load_soil(name).name
        if (folder := run_folder(run_id_of(terrain, scenario, number), out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
    gradient = math.tan(math.radians(settings.grade_deg))
    run_ids: list[str] = []
    total_s = 0.0
    for done, (name, number) in enumerate(jobs):
        run = simulate_run(
            robot,
            name,
            scenario,
            settings.seed,
            number,
            duration_s=settings.duration_s,
            vary=settings.vary,
            conditions=Conditions(payload_kg=settings.payload_kg, grade_ratio=(gradient, 0.0)),
            faults=Faults(camera_lost_s=settings.camera_lost_s),
            gnss=Gnss() if settings.gnss else None,
            effects=effects,
        )
        write_run(run, out)
        run_ids.append(run.run_id)
        total_s += run.streams["imu" if "imu" in run.streams else "wheels"].duration_s
        progress("simulate", done + 1, len(jobs))
    return SimulatedRuns(
        out, robot.name, scenario, settings.seed, effects, len(run_ids), tuple(run_ids), total_s
    )


def _effects(given: Sequence[str], drive: str) -> dict[str, float]:
    """Return the parameters that all ``NAME=VALUE`` set together."""
    acting: dict[str, float] = {}
    for text in given:
        for name, value in read_effect(text, drive).items():
            if name in acting:
                raise ConfigError(f"effect {text.partition('=')[0]!r} is given twice")
            acting[name] = value
    return acting
