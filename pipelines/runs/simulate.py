"""``terrain simulate``: seeded run folders of a simulated robot, the truth beside what its sensors say."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.reporting.progress import Progress, silent
from terrain.effects import NUISANCES, PARAMETER, SENSED_ONLY, read_effect
from terrain.errors import ConfigError, LogError
from terrain.files.atomic import ensure_writable
from terrain.logs.write import run_folder, write_run
from terrain.records import Array, RunLog, Stream
from terrain.robots import Robot, load_robot
from terrain.simulation.bench import POSITIONS, TURN_S, six_positions_log
from terrain.simulation.conditions import Conditions, Faults, draw_conditions, load_spread
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.planar.ground import planar_ground
from terrain.simulation.planar.noise import load_noise, load_scatter
from terrain.simulation.planar.run import Hills, simulate_planar
from terrain.simulation.scenario import make_scenario
from terrain.simulation.sensors import Gnss
from terrain.simulation.slip_sweep import learning_run
from terrain.terramechanics.soil import Soil, load_soil, scattered, soil_names

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
    effects: Mapping[str, float] | None = None,
) -> RunLog:
    """Return one simulated run.

    What is drawn depends on ``seed``, ``terrain``, ``scenario`` and ``number`` alone: a run is the same
    whatever is simulated beside it.  A skid-steer robot goes to the planar simulation.

    Parameters
    ----------
    robot : swerve robot with all sections, or skid-steer robot with all but steering
    terrain : name of a soil or path of its YAML file, or ``course`` for all soils in one run
    scenario : name of a scenario; ``course`` goes with the terrain ``course``, ``six_positions`` (the IMU
        alone, for calibration) with ``bench``; ``slip`` takes the wheels through their slips on varied days
    seed, number : which draw
    duration_s : length; the scenario's own by default
    vary : draw soil, slope, load, tyres and roughness for this run as ``data/soils`` and ``data/spread`` tell
    conditions : nominal conditions
    faults : what the sensors suffer on purpose
    gnss : receiver on board, if any
    effects : parameters of :mod:`terrain.effects.catalogue` that act

    Raises
    ------
    ConfigError
        if the terrain or scenario is unknown or they do not go together, or the robot cannot do it.
    """
    if effects and scenario in (BENCH, SLIP):
        raise ConfigError(f"scenario {scenario!r} is simulated without effects: leave them out")
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
    if robot.drive != "swerve" and terrain == COURSE:
        raise ConfigError(f"robot {robot.name}: scenario {COURSE!r} is for swerve robots")
    drive = make_scenario(scenario, robot, names, duration_s, seed=drive_seed)
    if robot.drive != "swerve":
        if gnss is not None:
            raise ConfigError(f"robot {robot.name}: its simulation has no receiver, leave gnss out")
        log = _planar_run(
            robot,
            soils[terrain],
            drive.twist,
            simulated,
            run_id_of(terrain, scenario, number),
            conditions or Conditions(),
            vary,
            effects or {},
        )
        return log if faults is None else _without_camera(log, faults)
    return simulate(
        robot,
        drive,
        soils,
        simulated,
        run_id=run_id_of(terrain, scenario, number),
        conditions=conditions,
        faults=Faults() if faults is None else faults,
        gnss=gnss,
        effects=effects,
    )


def _planar_run(
    robot: Robot,
    soil: Soil,
    twist: Array,
    seed: np.random.SeedSequence,
    run_id: str,
    conditions: Conditions,
    vary: bool,
    effects: Mapping[str, float],
) -> RunLog:
    """Return a run of the planar simulation; what its sensors scatter, they do on a nominal day too."""
    scatter = load_scatter()
    if not vary:
        fixed = (name for name in NUISANCES if name in PARAMETER and name not in SENSED_ONLY)
        scatter = scatter._replace(**dict.fromkeys(fixed, 0.0))
    load = conditions.payload_kg / robot.mass_kg
    return simulate_planar(
        robot,
        twist,
        seed,
        ground=planar_ground(robot, soil),
        effects={**effects, "payload_ratio": effects.get("payload_ratio", 0.0) + load},
        scatter=scatter,
        hills=Hills(conditions.grade_ratio, conditions.undulation_ratio, conditions.undulation_length_m),
        noise=load_noise(),
        run_id=run_id,
        terrain=soil.name,
    )


def _without_camera(run: RunLog, faults: Faults) -> RunLog:
    """Return the run without the camera's samples of the times in which it is lost."""
    seen = run.streams["odometry"]
    kept = np.ones(len(seen), dtype=bool)
    for start_s, end_s in faults.camera_lost_s:
        kept &= (seen.time_s < start_s) | (seen.time_s >= end_s)
    left = Stream(seen.time_s[kept], seen.values[kept], seen.channels)
    streams = {name: left if name == "odometry" else stream for name, stream in run.streams.items()}
    if len(left) < 2:
        del streams["odometry"]
    return RunLog(run.run_id, run.robot, streams, run.labels, run.source)


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
    """Return one of the drives of :mod:`terrain.simulation.slip_sweep`, which draw all conditions."""
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


def run_id_of(terrain: str, scenario: str, number: int) -> str:
    """Return the name of a simulated run.

    Examples
    --------
    >>> run_id_of("grass", "straight", 3), run_id_of("course", "course", 12)
    ('grass_straight_03', 'course_12')
    """
    return f"{terrain}_{number:02d}" if terrain == scenario else f"{terrain}_{scenario}_{number:02d}"
