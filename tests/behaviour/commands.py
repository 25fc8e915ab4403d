"""What is run: cases of command lines on small inputs that are simulated or computed, none of them measured.

A case is run in an empty folder of its own, its steps one after another; a step may use what one before it
wrote.  Every step that is expected to succeed also gets ``--json``.
"""

from __future__ import annotations

import gzip
import math
import random
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from pipelines.cli.table import COMMANDS as TABLE

COMMANDS = tuple(each.name for each in TABLE)


@dataclass(frozen=True, slots=True)
class Step:
    """One command line without the word ``terrain``, and the exit code that is expected."""

    words: str
    code: int = 0


@dataclass(frozen=True, slots=True)
class Case:
    """Command lines that belong together."""

    name: str  #: of the case, and of the file with its result
    steps: tuple[Step, ...] = ()  #: in order
    #: returns files that lie there before, by path
    make: Callable[[], Mapping[str, bytes]] = field(default=dict)
    helps: tuple[str, ...] = ()  #: commands whose options are listed; an empty name is ``terrain --help``


def steps(*lines: str | Step) -> tuple[Step, ...]:
    """Return steps; a plain line is expected to succeed."""
    return tuple(line if isinstance(line, Step) else Step(line) for line in lines)


def refused(words: str) -> Step:
    """Return a step that is a user's mistake."""
    return Step(words, 2)


def foreign_logs() -> dict[str, bytes]:
    """Return logs in the layouts of BorealTC and DRIVE, in CSV files of one's own, and one with faults."""
    files = {}
    for terrain, size in (("ICE", 0.2), ("SNOW", 0.28)):
        for number in (1, 2, 3):
            imu, wheels = _imu_rows(size + 0.1 * number), _wheel_rows(size + 0.1 * number)
            files[f"borealtc/{terrain}/imu_{number:02d}.csv"] = _csv("time,wx,wy,wz,ax,ay,az", imu)
            files[f"borealtc/{terrain}/pro_{number:02d}.csv"] = _csv("time,curL,curR,velL,velR", wheels)
            files[f"own/{terrain}/imu {number}.csv"] = _csv("stamp,wx,wy,yaw rate,ax,ay,az", _in_ms(imu))
            files[f"own/{terrain}/wheels {number}.csv"] = _csv("t,cl,cr,vl,vr", wheels)
    spoilt = _imu_rows(0.4)
    spoilt[17][3] = math.nan
    spoilt[60][0] = spoilt[59][0]
    files["spoilt/ICE/imu_01.csv"] = _csv("time,wx,wy,wz,ax,ay,az", spoilt)
    files["spoilt/ICE/pro_01.csv"] = _csv("time,curL,curR,velL,velR", _wheel_rows(0.4))
    files["mapping.yaml"] = MAPPING.encode()
    files["drive/samples.csv.gz"] = gzip.compress(_csv(DRIVE_COLUMNS, _drive_rows()), mtime=0)
    return files


PATH_POINTS = "x_m,y_m\n0,0\n5,0\n10,0.5\n15,2\n20,4\n25,5\n30,5\n"  #: Of a gentle S-bend

TRIAL_COLUMNS = (
    "trial_num,beta,slip,Vry,avg_Vx,std_Vx,avg_Vry,std_Vry,avg_Fx,std_Fx,avg_Fy,std_Fy,avg_Fz,std_Fz,"
    "avg_angle,avg_Z,std_Z"
)


def testbed_trials() -> dict[str, bytes]:
    """Return trials of a wheel testbed at 35 settings, by a formula, and a file with a fault."""
    rows = []
    for speed in (0.0, 5.0, 10.0, 20.0, 40.0):
        for beta in range(0, 91, 15):
            slip, angle = (speed - 10.0) / max(speed, 10.0), math.radians(beta)
            pull, side = 12.0 * slip - 4.0 * math.cos(angle), 14.0 * math.sin(angle) * (1.5 - slip)
            depth = 14.0 + 12.0 * abs(slip) + 20.0 * math.sin(angle)
            speeds = (1.0, beta, slip, speed, 10.0, 0.1, speed, 0.1)
            rows.append([*speeds, side, 0.5, -pull, 0.5, -22.0, 0.2, beta, -depth, 0.1])
    spoilt = [*rows[:2], rows[1]]
    return {"bed/smooth.csv": _csv(TRIAL_COLUMNS, rows), "spoilt/smooth.csv": _csv(TRIAL_COLUMNS, spoilt)}


MAPPING = """\
robot: husky
terrain: "{terrain}"
streams:
  imu:
    file: "{terrain}/imu {run}.csv"
    time: {column: stamp, unit: ms}
    channels:
      gyro_z_radps: {column: yaw rate, unit: deg/s, scale: -1}
      accel_x_mps2: {column: ax, unit: m/s^2}
  wheels:
    file: "{terrain}/wheels {run}.csv"
    time: {column: t, unit: s}
    channels:
      speed_left_mps: {column: vl, unit: km/h}
      speed_right_mps: {column: vr, unit: km/h}
"""

TOPICS = """\
robot: agrimaro
labels: /terrain/label
streams:
  imu: {topic: /imu, kind: imu}
  odometry: {topic: /odometry, kind: odometry}
  commands: {topic: /cmd_vel, kind: twist}
  wheels:
    topic: /joint_states
    kind: joints
    channels:
      motor_1_radps: {joint: motor_1, field: velocity}
      motor_2_radps: {joint: motor_2, field: velocity}
      motor_3_radps: {joint: motor_3, field: velocity}
"""

DRIVE_COLUMNS = (
    "step,window,steady,time,cmd_left,cmd_right,wheel_left,wheel_right,"
    "icp_x,icp_y,icp_z,icp_roll,icp_pitch,icp_yaw,imu_yaw,imu_ax,imu_ay,imu_az"
)


def _wave(i: int, k: int) -> float:
    return round(math.sin(0.37 * i * (k + 1) + k) + 0.3 * math.sin(1.91 * i + k * k), 6)


def _imu_rows(size: float) -> list[list[float]]:
    shaken = _shaken(size, 6, 800)
    return [[i / 50, *row[:5], 9.81 + row[5]] for i, row in enumerate(shaken)]


def _wheel_rows(size: float) -> list[list[float]]:
    return [[i / 10, *(3 + value for value in row)] for i, row in enumerate(_shaken(size, 4, 160))]


def _shaken(size: float, n_channels: int, n: int) -> list[list[float]]:
    """Return waves with noise of their own for each run: copies of one run would be refused."""
    rng = random.Random(round(1000 * size) + n_channels)
    return [
        [round(size * (_wave(i, k) + rng.gauss(0.0, 0.3)), 6) for k in range(n_channels)] for i in range(n)
    ]


def _in_ms(rows: list[list[float]]) -> list[list[float]]:
    return [[1000 * row[0], *row[1:]] for row in rows]


def _drive_rows() -> list[list[float]]:
    """Return three commands of three windows: arcs at one speed, each with a pose every second sample."""
    rows: list[list[float]] = []
    for step, (speed, turn) in enumerate(((0.5, 0.0), (0.7, 0.4), (-0.4, -0.3))):
        for window in range(3):
            for sample in range(40):
                passed = sample // 2 * 0.1
                pose = [speed * passed, 0.5 * speed * turn * passed**2, 0, 0, 0, turn * passed]
                wheels = [(speed - 0.3 * turn) / 0.165, (speed + 0.3 * turn) / 0.165]
                shaken = [0.01 * _wave(sample + 40 * window, k) for k in range(4)]
                imu = [turn + shaken[0], shaken[1], shaken[2], 9.81 + shaken[3]]
                measured = [wheels[0] + shaken[0], wheels[1] + shaken[1], *pose, *imu]
                rows.append([step, window, int(window > 0), 0.05 * sample, *wheels, *measured])
    return rows


def _csv(head: str, rows: Iterable[Iterable[float]]) -> bytes:
    lines = [",".join("" if math.isnan(value) else f"{value:.9g}" for value in row) for row in rows]
    return ("\n".join([head, *lines]) + "\n").encode()


SLIPPING = "--robot agrimaro --terrain grass --scenario slip --runs 6"

CASES: tuple[Case, ...] = (
    Case("help", helps=("", *COMMANDS)),
    Case(
        "reading",
        steps(
            "simulate --robot agrimaro --terrain grass --scenario straight --duration 8 --gnss "
            "--camera-lost 4:5 --payload 10 --grade 3 --out raw",
            "inspect raw",
            "convert raw --out copy",
            refused("convert raw --out copy"),
        ),
    ),
    Case(
        "foreign_logs",
        steps(
            "convert borealtc --out of_borealtc",
            "inspect borealtc",
            "convert own --mapping mapping.yaml --out of_own",
            "convert drive --out of_drive",
            refused("inspect spoilt"),
            "convert spoilt --repair --out of_spoilt",
        ),
        foreign_logs,
    ),
    Case("quickstart", steps("quickstart --data borealtc --out report --jobs 1"), foreign_logs),
    Case(
        "simulate",
        steps(
            "simulate --robot agrimaro --terrain all --scenario survey --duration 9 --vary --out all",
            "simulate --robot agrimaro --terrain course --scenario course --vary --seed 1 --out course",
            "simulate --robot husky --terrain tilled_loam --scenario spot_turn --duration 8 "
            "--effect effective_track=0.3 --effect wheel_radius=0.02 --out husky",
            "simulate --robot agrimaro --terrain clay --scenario arc --duration 12 "
            "--effect camera_latency=0.1 --effect payload=0.3 --out arc",
        ),
    ),
    Case(
        "faults",
        steps(
            "drive --faults loss_odometry,late_30ms_imu --situations steady --durations 3 --seed 3 --jobs 1 "
            "--out page",
        ),
    ),
    Case(
        "calibrate",
        steps(
            "simulate --robot agrimaro --terrain bench --scenario six_positions --out bench",
            "calibrate --data bench --robot agrimaro --out bench.yaml",
            "simulate --robot agrimaro --terrain tiles --scenario stand --out hard",
            "simulate --robot agrimaro --terrain tiles --scenario starts --out hard",
            "simulate --robot agrimaro --terrain tiles --scenario complex --out hard",
            "calibrate --data hard --robot agrimaro --out hard.yaml",
        ),
    ),
    Case(
        "estimate_swerve",
        steps(
            "simulate --robot agrimaro --terrain grass --scenario straight --duration 8 --camera-lost 4:6 "
            "--seed 5 --out raw",
            "estimate --data raw --filter encoder12 --out encoder12",
            "estimate --data raw --filter vio12 --out vio12",
            "estimate --data raw --filter vio15 --out vio15 --figures vio15/figures",
            "estimate --data raw --filter vio15 --tuning likelihood",
        ),
    ),
    Case(
        "estimate_skid",
        steps(
            "simulate --robot husky --terrain grass --scenario survey --duration 20 --runs 2 --out raw",
            "estimate --data raw --filter skid --out skid",
        ),
    ),
    Case(
        "observers",
        steps(
            "simulate --robot orchard_ugv --terrain tilled_loam --scenario complex --grade 5 --runs 5 "
            "--out raw",
            "estimate --data raw --filter tracked --out tracked --figures tracked/figures",
            "estimate --data raw --filter slip-learning --out learning",
            "estimate --data raw --filter gyrodometry",
            "calibrate --what odometry --data raw --robot orchard_ugv --folds 5 --lengths 4 --out slip.yaml",
            "estimate --data raw --filter slip-odometry --slip-model slip.yaml",
            refused("estimate --data raw --filter slip-odometry"),
        ),
    ),
    Case(
        "learning",
        steps(
            "simulate --robot agrimaro --terrain all --scenario survey --duration 16 --runs 2 --vary "
            "--out raw",
            "estimate --data raw --filter vio15 --out runs",
            "crossval --data runs --repeats 2 --jobs 1",
            "crossval --data runs --protocol leave-one-run-out --signals imu,currents --no-extras --jobs 1",
            "crossval --data runs --protocol published --repeats 1 --no-extras --jobs 1",
            "crossval --data runs --cache cache --repeats 1 --no-extras --jobs 1",
            "crossval --data runs --protocol leave-terrain-out --repeats 1 --no-extras --jobs 1",
            "crossval --data runs --recipe svm@imu,wheels,svm@currents --repeats 1 --jobs 1",
            "train --data runs --name searched --search 4 --trials search --repeats 1 --jobs 1",
            "crossval --data runs --repeats 1 --no-extras --jobs 1 --params search/best.json",
            "train --data runs --name field --repeats 1 --jobs 1",
            "inspect models:/field@champion",
            "predict --model models:/field@champion --data runs",
            "predict --model models:/field@champion --data runs --filter-stride 0.5",
            "label runs --model models:/field@champion --ask 3",
            refused("label runs --answers proposals.csv --out labelled --accept 1"),
            "serve --model models:/field@champion --robot agrimaro --port 0 --check",
            refused("serve --model models:/field@champion --robot husky --port 0 --check"),
            "drive --scenario starts --terrain grass --controllers plain,classified --seeds 2 --jobs 1 "
            "--model models:/field@champion",
        ),
    ),
    Case(
        "slip",
        steps(
            f"simulate {SLIPPING} --out pull",
            "learn-slip --data pull --robot agrimaro --out table.yaml --figures figures",
            "drive --scenario starts --terrain grass --table table.yaml --seeds 2 --jobs 1 --out page "
            "--controllers plain,ramp,thesis,fallback,true_terrain,known:grass,target:0.3,true_terrain+track",
        ),
    ),
    Case(
        "drive",
        steps(
            "drive --scenario course --terrain course --controllers plain,fallback,known:clay --seeds 2 --jobs 1",
            "drive --scenario slope --terrain dry_sand --controllers plain,true_terrain --seeds 2 --jobs 1",
            "drive --scenario circle --terrain tiles --radius 1,1.02,1 --leg-backlash 0.02 "
            "--controllers plain,true_terrain,true_terrain+track --seeds 2 --jobs 1",
            "drive --scenario brake --terrain wet_floor --grade -5 --ramp 0.4 --seeds 2 "
            "--controllers plain,ramp,true_terrain --seed 7 --jobs 1",
        ),
    ),
    Case(
        "replay",
        steps(
            "simulate --robot agrimaro --terrain grass --scenario survey --duration 12 --out raw",
            "serve --replay raw",
            "serve --replay raw --speed 40 --rate 20",
        ),
    ),
    Case(
        "label",
        steps(
            "convert borealtc --out raw",
            "label raw",
            "label raw --run ICE_01 --from 2 --to 6 --terrain SLUSH",
            "label raw --run ICE_02 --all --remove",
            "label raw/ICE_03 --run ICE_03 --from 4 --to 5 --remove",
            "inspect raw",
        ),
        foreign_logs,
    ),
    Case(
        "explain_husky",
        steps(
            "simulate --robot husky --terrain grass --scenario survey --runs 4 --duration 30 "
            "--effect effective_track=0.4 --out raw",
            "explain --data raw --robot husky --out explained",
        ),
    ),
    Case(
        "explain_agrimaro",
        steps(
            "simulate --robot agrimaro --terrain grass --scenario survey --runs 6 --duration 30 "
            "--effect wheel_radius=0.03 --out raw",
            "explain --data raw --robot agrimaro --out explained",
            "explain --data raw --robot agrimaro --model explained/extended.yaml --out again",
        ),
    ),
    Case(
        "testbed",
        steps(
            "convert bed --out trials",
            refused("convert spoilt --out other"),
            "convert spoilt --format testbed --repair --out other",
            "calibrate --what soil --data trials --out soil --figures soil --draws 2 "
            "--laws simulator,wong_reece",
        ),
        testbed_trials,
    ),
    Case(
        "measured_slip",
        steps(
            "simulate --robot husky --terrain grass --scenario straight --runs 4 --duration 12 --out raw",
            "simulate --robot husky --terrain snow --scenario straight --runs 2 --duration 12 --out more",
            "estimate --filter pose --data raw",
            "simulate --robot robotino --terrain tiles --scenario crab --duration 20 --runs 3 --out omni",
            "estimate --filter pose --data omni --robot robotino",
            "explain --data omni --robot robotino --out explained --pictures 1",
            "predict --data more --changes raw",
            refused("predict --data raw --changes raw"),
            "learn-slip --robot husky --data raw --out table.yaml",
            refused("learn-slip --robot warthog --data raw --out other.yaml"),
        ),
    ),
    Case(
        "track",
        steps(
            "drive --robot adap2e --path path.csv --speed 2 --stop 6 --out page",
            "drive --robot adap2e --path path.csv --speed 3 --observer none --slope 10 --out plain",
        ),
        lambda: {"path.csv": PATH_POINTS.encode()},
    ),
    Case("can", steps("serve --can virtual:behaviour --duration 0")),
    Case(
        "bags",
        steps(
            "simulate --robot agrimaro --terrain grass --scenario survey --duration 12 --out raw",
            "convert raw --to mcap --out mcap",
            "convert raw --to ros2 --out ros2",
            "convert mcap --out of_mcap",
            "convert ros2 --format bag --out of_ros2",
            "convert mcap --format bag --mapping topics.yaml --out of_topics",
            "inspect mcap",
            "serve --replay mcap/grass_survey_01.mcap --rate 20",
        ),
        lambda: {"topics.yaml": TOPICS.encode()},
    ),
    Case(
        "refusals",
        steps(
            refused("simulate --robot nobody --terrain grass --scenario straight --out out"),
            refused("inspect nowhere"),
            refused("crossval --data nowhere --signals imu"),
            refused("drive --grade 50"),
        ),
    ),
)
"""All cases; the names are those of the files with the results."""
