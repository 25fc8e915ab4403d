"""Simulate runs of a described robot: ordinary run folders, with the truth beside the measurements."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.report.numbers import enumerated, plural
from pipelines.report.results import Progress, Result, described, silent
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.settings import setting
from pipelines.report.tree import Report, Text
from terrain.errors import ConfigError, LogError

if TYPE_CHECKING:
    from terrain.records import RunLog
    from terrain.robots import Robot

EXAMPLE = "terrain simulate --robot husky --terrain grass --scenario survey --runs 8 --out runs/"
EVERY = "all"  #: Given in place of a terrain: each soil in turn
#: Why runs of a drive carry less of the terrain than those of tyres, of whose windows on eight soils 60 to 75 % are
#: classified rightly: of a tracked robot 54 %, of three omni wheels 42 % on four firm floors.
LITTLE_TERRAIN = {
    "tracked": "Tracks bridge the roughness of the ground and hardly slip",
    "omni": "Rollers vibrate alike on firm floors, and spin on soft ground",
}
STUCK_RATIO = 0.2  #: Of the distance that its wheels roll, below which a robot hardly moves
REFERENCES = ("odometry", "gnss", "pose")  #: Streams by which a speed over ground is known


class Settings(BaseSettings):
    """What is simulated, and where to."""

    robot: str = setting(..., "Robot by name, or its YAML file.")
    terrain: str = setting(..., "Name of a soil, 'all' for each in turn, 'course' or 'bench'.")
    scenario: str = setting(...)
    """stand, straight, arc, starts, climb, brake, circle, crab, spot_turn, complex, survey; slip, for learn-slip;
    course on 'course', six_positions on 'bench'; or a CSV file of commands, as next_drive.csv of explain."""
    out: Path = setting(..., "Folder of the new run folders.")
    runs: int = setting(1, "Number of runs for each terrain.", ge=1)
    duration_s: float | None = setting(None, "Length of a run in s.", option="--duration")
    seed: int = setting(0, "Seed of everything that is drawn.", ge=0)
    vary: bool = setting(False, "Draw soil, slope, load and tyres anew for each run.")
    grade_deg: float = setting(0.0, option="--grade", ge=-30.0, le=30.0)
    """Slope along the start's heading in degrees, uphill > 0."""
    payload_kg: float = setting(0.0, "Load in kg.", option="--payload", ge=0.0)
    camera_lost: tuple[str, ...] = setting((), repeated=True)
    """START:END in s without the camera; may be given again."""
    gnss: bool = setting(False, "With an RTK receiver on board.")
    pose: bool = setting(False, "With poses (x, y, yaw) of a lidar or of cameras in a fixed frame.")
    effect: tuple[str, ...] = setting((), repeated=True)
    """NAME=VALUE of an effect that acts, as wheel_radius=0.03; may be given again."""


class SimulatedRuns(Result):
    """Run folders that were simulated."""

    out: Path = described("folder of the run folders")
    robot: str = described("robot of the runs")
    scenario: str = described("scenario of the runs")
    seed: int = described("of everything that was drawn")
    effects: Mapping[str, float] = described("parameters of effects that act, by name")
    n_runs: int = described("number of runs")
    run_ids: tuple[str, ...] = described("names of the runs")
    duration_s: float = described("of all runs together", "s")
    limits: tuple[str, ...] = described("what these runs cannot show, a sentence each")


def run(settings: Settings, progress: Progress = silent) -> SimulatedRuns:
    """Simulate runs and write them as run folders."""
    import math

    from terrain.effects import read_effects_of
    from terrain.files.atomic import ensure_writable
    from terrain.logs.run_folders import run_folder, write_run
    from terrain.logs.tables import read_table
    from terrain.robots import load_robot
    from terrain.simulation.run import BENCH_TERRAIN, COURSE, run_id_of, simulate_run
    from terrain.simulation.scenario import COMMANDS, Conditions, Faults, Scenario, from_commands
    from terrain.simulation.sensors import Gnss, Poses
    from terrain.terramechanics.soil import load_soil, soil_names

    scenario, out = settings.scenario, settings.out
    camera_lost_s = []
    for text in settings.camera_lost:
        try:
            start_s, end_s = map(float, text.split(":"))
        except ValueError:
            start_s = end_s = 0.0
        if not 0.0 <= start_s < end_s:
            raise ConfigError(f"--camera-lost is {text!r}; START:END in seconds is required, as in 10:13")
        camera_lost_s.append((start_s, end_s))
    robot = load_robot(settings.robot)
    effects = read_effects_of(settings.effect, robot.drive)
    ensure_writable(out)
    terrains = soil_names() if settings.terrain == EVERY else (settings.terrain,)
    commands = None
    if scenario.lower().endswith(".csv"):
        commands, scenario = read_table(Path(scenario), COMMANDS), Path(scenario).stem
    jobs = [(name, number) for name in terrains for number in range(1, settings.runs + 1)]
    for name, number in jobs:
        terrain = name if name in (COURSE, BENCH_TERRAIN) else load_soil(name).name
        if (folder := run_folder(run_id_of(terrain, scenario, number), out)).exists():
            raise LogError(f"{folder}: is there already, and is left as it is; choose another --out")
    gradient = math.tan(math.radians(settings.grade_deg))
    run_ids: list[str] = []
    stuck, total_s = dict[str, None](), 0.0
    for done, (name, number) in enumerate(jobs, 1):
        driven: str | Scenario = scenario
        if commands is not None:
            driven = from_commands(scenario, robot, load_soil(name).name, commands)
        simulated = simulate_run(
            robot,
            name,
            driven,
            settings.seed,
            number,
            duration_s=settings.duration_s,
            vary=settings.vary,
            conditions=Conditions(payload_kg=settings.payload_kg, grade_ratio=(gradient, 0.0)),
            faults=Faults(camera_lost_s=tuple(camera_lost_s)),
            gnss=Gnss() if settings.gnss else None,
            poses=Poses() if settings.pose else None,
            effects=effects or None,
        )
        write_run(simulated, out)
        run_ids.append(simulated.run_id)
        stuck |= dict.fromkeys(simulated.terrains if hardly_moves(simulated, robot) else ())
        total_s += simulated.streams["imu" if "imu" in simulated.streams else "wheels"].duration_s
        progress("simulate", done, len(jobs))
    return SimulatedRuns(
        out,
        *(robot.name, scenario, settings.seed, effects, len(run_ids), tuple(run_ids), total_s),
        limits_of(simulated, robot, bool(effects), list(stuck)),
    )


def hardly_moves(run: RunLog, robot: Robot) -> bool:
    """Return whether the wheels of a simulated run roll far and take the robot nowhere."""
    import numpy as np

    from terrain.kinematics.wheels import rolled_twist

    truth = run.streams.get("truth")
    if truth is None:
        return False
    speed, steer = (
        np.column_stack([truth.channel(f"{quantity}_{wheel}_{unit}") for wheel in robot.wheels])
        for quantity, unit in (("wheel", "radps"), ("steer", "rad"))
    )
    rolled = rolled_twist(robot, speed * robot.wheel_radius_m, steer)
    driven = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    rolled_mps = np.hypot(rolled[:, 0], rolled[:, 1])
    return bool(driven.sum() < STUCK_RATIO * rolled_mps.sum())


def limits_of(run: RunLog, robot: Robot, with_effects: bool, stuck: list[str]) -> tuple[str, ...]:
    """Return what simulated runs cannot show, a sentence each.

    Parameters
    ----------
    run : one of them
    robot : as it is described
    with_effects : whether effects were asked for
    stuck : terrains on which it hardly moved
    """
    from terrain.robots import SwerveRobot
    from terrain.simulation.assumed import with_assumed

    if "wheels" not in run.streams:
        return ()
    limits = []
    if isinstance(robot, SwerveRobot) or not (with_effects or robot.effects or robot.learned):
        lacks = sorted(with_assumed(robot).parts.keys() - robot.parts.keys())
        if lacks:
            limits.append(
                f"Of robot {robot.name} {enumerated(lacks)} {'are' if len(lacks) > 1 else 'is'} assumed from its "
                "geometry and mass: terrains differ in vibration and currents as they do for such a robot, by other "
                "amounts than for yours."
            )
    else:
        limits.append(
            "With effects, the planar plant is used: it has no vibration of the ground and no load transfer, so "
            "its runs carry little of the terrain for a classifier."
        )
    if (why := LITTLE_TERRAIN.get(robot.drive)) is not None:
        limits.append(f"{why}: its runs carry little of the terrain for a classifier.")
    if not run.streams.keys() & set(REFERENCES):
        limits.append(
            "Nothing on board measures the speed over ground, so slip cannot be estimated: add --gnss or --pose, "
            "or the section 'camera' to the robot's description."
        )
    if stuck:
        limits.append(
            f"On {enumerated(stuck)} it hardly moves: its wheels spin, and the runs show little but that."
        )
    return tuple(limits)


def report(result: SimulatedRuns) -> Report:
    """Return how much was simulated."""
    length = f" of {result.duration_s:.0f} s" if result.n_runs == 1 else f", {result.duration_s:.0f} s in all"
    return Report(
        f"Simulated runs of {result.robot}",
        f"{plural(result.n_runs, 'run')}{length}, written to {result.out}.",
        parts=[Text(sentence) for sentence in result.limits],
        next_step=f"terrain inspect {result.out}",
    )
