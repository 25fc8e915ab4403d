"""``terrain simulate``: seeded run folders of a simulated robot, the truth beside what its sensors say."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluation import Progress, silent
from pipelines.slip_drives import learning_run
from terrain.atomic import ensure_writable
from terrain.errors import ConfigError, LogError
from terrain.logs.write import run_folder, write_run
from terrain.records import RunLog
from terrain.robots import Robot, load_robot
from terrain.simulation.bench import POSITIONS, TURN_S, six_positions_log
from terrain.simulation.conditions import Conditions, Faults, draw_conditions, load_spread
from terrain.simulation.scenario import make_scenario
from terrain.simulation.sensors import Gnss
from terrain.simulation.simulate import simulate
from terrain.terramechanics.soil import load_soil, scattered, soil_names

COURSE = "course"
"""Word for a way over all terrains instead of the name of one."""

BENCH = "six_positions"
"""Word for the IMU alone on a bench, in place of a scenario."""

BENCH_TERRAIN = "bench"
"""The terrain that goes with it."""

SLIP = "slip"
"""Word for drives that take the wheels through their slips, for ``terrain learn-slip``."""

EVERY = "all"
"""Word for each terrain in turn."""


def simulate_run(
    robot: Robot,
    terrain: str,
    scenario: str,
    seed: int,
    number: int = 1,
    *,
    duration_s: float | None = None,
    vary: bool = False,
    conditions: Conditions | None = None,
    faults: Faults | None = None,
    gnss: Gnss | None = None,
) -> RunLog:
    """Return one simulated run.

    What is drawn depends on ``seed``, ``terrain``, ``scenario`` and ``number`` alone: a run is the same
    whatever is simulated beside it.

    Parameters
    ----------
    robot : robot with all sections
    terrain : name of a soil or path of its YAML file, or ``course`` for all soils in one run
    scenario : name of a scenario; ``course`` goes with the terrain ``course``, ``six_positions`` (the IMU
        alone, for calibration) with ``bench``; ``slip`` takes the wheels through their slips on varied days
    seed, number : which draw
    duration_s : length; the scenario's own by default
    vary : draw soil, slope, load, tyres and roughness for this run as ``data/soils`` and ``data/spread`` tell
    conditions : nominal conditions
    faults : what the sensors suffer on purpose
    gnss : receiver on board, if any

    Raises
    ------
    ConfigError
        if the terrain or scenario is unknown or they do not go together.
    """
    if scenario == BENCH:
        return _bench(robot, terrain, seed, number, duration_s)
    if scenario == SLIP:
        return _through_slips(robot, terrain, seed, number, duration_s, conditions, faults, gnss)
    if (terrain == COURSE) != (scenario == COURSE):
        raise ConfigError("terrain 'course' and scenario 'course' go together: give both or neither")
    soils = {soil.name: soil for soil in map(load_soil, soil_names() if terrain == COURSE else (terrain,))}
    names = list(soils)
    terrain = terrain if terrain == COURSE else names[0]
    key = [seed, zlib.crc32(terrain.encode()), zlib.crc32(scenario.encode()), number]
    drawn, driven, simulated = np.random.SeedSequence(key).spawn(3)
    if vary:
        rng = np.random.default_rng(drawn)
        soils = {name: scattered(soil, rng) for name, soil in soils.items()}
        conditions = draw_conditions(load_spread(), rng, conditions)
    drive_seed = int(driven.generate_state(1)[0])
    drive = make_scenario(scenario, robot, names, duration_s, seed=drive_seed)
    return simulate(
        robot,
        drive,
        soils,
        simulated,
        run_id=run_id_of(terrain, scenario, number),
        conditions=conditions,
        faults=Faults() if faults is None else faults,
        gnss=gnss,
    )


def _through_slips(
    robot: Robot,
    terrain: str,
    seed: int,
    number: int,
    duration_s: float | None,
    conditions: Conditions | None,
    faults: Faults | None,
    gnss: Gnss | None,
) -> RunLog:
    """Return one of the drives of :mod:`pipelines.slip_drives`, which draw everything of their day."""
    if terrain == COURSE:
        raise ConfigError(f"scenario {SLIP!r} is driven on one terrain, not on 'course'")
    if duration_s is not None or conditions not in (None, Conditions()) or gnss is not None:
        raise ConfigError(f"scenario {SLIP!r} draws its own day: leave duration, grade, payload and gnss out")
    if faults not in (None, Faults()):
        raise ConfigError(f"scenario {SLIP!r} has no faults on purpose: leave the camera's loss out")
    ground = load_soil(terrain).name
    return learning_run(robot, terrain, seed, number, run_id=run_id_of(ground, SLIP, number))


def _bench(robot: Robot, terrain: str, seed: int, number: int, duration_s: float | None) -> RunLog:
    """Return the log of an IMU that is held still in six positions, for ``terrain calibrate``."""
    if terrain != BENCH_TERRAIN:
        raise ConfigError(
            f"scenario {BENCH!r} is done on a bench: give the terrain {BENCH_TERRAIN!r}, not {terrain!r}"
        )
    hold_s = 5.0 if duration_s is None else duration_s / len(POSITIONS) - TURN_S
    key = np.random.SeedSequence([seed, zlib.crc32(BENCH.encode()), number])
    return six_positions_log(
        robot, key, hold_s=hold_s, run_id=run_id_of(terrain, scenario=BENCH, number=number)
    )


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
    others : as :func:`simulate_run`

    Returns
    -------
    dict that JSON can hold
        ``out, robot, scenario, seed, n_runs, run_ids, duration_s``

    Raises
    ------
    ConfigError
        if an option is not accepted.
    LogError
        if a run of that name is there already; nothing is written then.
    """
    robot = load_robot(robot_name)
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
        "n_runs": len(run_ids),
        "run_ids": run_ids,
        "duration_s": total_s,
    }


def run_id_of(terrain: str, scenario: str, number: int) -> str:
    """Return the name of a simulated run.

    Examples
    --------
    >>> run_id_of("grass", "straight", 3), run_id_of("course", "course", 12)
    ('grass_straight_03', 'course_12')
    """
    return f"{terrain}_{number:02d}" if terrain == scenario else f"{terrain}_{scenario}_{number:02d}"
