"""``terrain simulate``: seeded run folders of a simulated robot, the truth beside what its sensors say."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipelines.reporting.progress import Progress, silent
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


def simulate_runs(
    robot_name: str,
    terrain: str,
    scenario: str,
    out: Path,
    *,
    runs: int = 1,
    duration_s: float | None = None,
    seed: int = 0,
    vary: bool = False,
    conditions: Conditions | None = None,
    faults: Faults | None = None,
    gnss: bool = False,
    effects: Sequence[str] = (),
    progress: Progress = silent,
) -> dict[str, Any]:
    """Simulate runs and write them as run folders.

    Parameters
    ----------
    robot_name : name of a robot or path of its YAML file
    terrain : name of a soil or path of its YAML file, ``all`` for each in turn, or ``course``
    scenario : name of a scenario
    out : folder of the new run folders
    runs : runs a terrain
    effects : what acts, each ``NAME=VALUE`` as :func:`terrain.effects.catalogue.read_effect` takes it
    others : as :func:`simulate_run`

    Returns
    -------
    dict that JSON can hold
        ``out, robot, scenario, seed, effects, n_runs, run_ids, duration_s``

    Raises
    ------
    ConfigError
        if an option is not accepted.
    LogError
        if a run of that name is there already; nothing is written then.
    """
    robot = load_robot(robot_name)
    acting = _effects(effects, robot.drive)
    ensure_writable(out)
    terrains = soil_names() if terrain == EVERY else (terrain,)
    jobs = [(name, number) for name in terrains for number in range(1, runs + 1)]
    for name, number in jobs:
        ground = name if name in (COURSE, BENCH_TERRAIN) else load_soil(name).name
        if (folder := run_folder(run_id_of(ground, scenario, number), out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
    run_ids: list[str] = []
    total_s = 0.0
    for done, (name, number) in enumerate(jobs):
        run = simulate_run(
            robot,
            name,
            scenario,
            seed,
            number,
            duration_s=duration_s,
            vary=vary,
            conditions=conditions,
            faults=faults,
            gnss=Gnss() if gnss else None,
            effects=acting,
        )
        write_run(run, out)
        run_ids.append(run.run_id)
        total_s += run.streams["imu"].duration_s
        progress("simulate", done + 1, len(jobs))
    return {
        "out": str(out),
        "robot": robot.name,
        "scenario": scenario,
        "seed": seed,
        "effects": acting,
        "n_runs": len(run_ids),
        "run_ids": run_ids,
        "duration_s": total_s,
    }


def _effects(given: Sequence[str], drive: str) -> dict[str, float]:
    """Return the parameters that all ``NAME=VALUE`` set together."""
    acting: dict[str, float] = {}
    for text in given:
        for name, value in read_effect(text, drive).items():
            if name in acting:
                raise ConfigError(f"effect {text.partition('=')[0]!r} is given twice")
            acting[name] = value
    return acting
