"""What is run: cases of command lines on small inputs that are simulated or computed, none of them measured.

``commands.yaml`` lists them.  Every step that is expected to succeed also gets ``--json``.
"""

from __future__ import annotations

import gzip
import math
import random
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

from pipelines.cli.table import COMMANDS as TABLE
from terrain.files.documents import read_yaml

COMMANDS = tuple(each.name for each in TABLE)


class Case(NamedTuple):
    """Command lines that belong together."""

    name: str  #: of the case, and of the file with its result
    steps: tuple[str, ...]  #: in order; behind ``!`` is a user's mistake, whose exit code is 2
    make: Callable[[], Mapping[str, bytes]]  #: returns files that lie there before, by path
    helps: tuple[str, ...]  #: commands whose options are listed; an empty name is ``terrain --help``


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


MAKERS: dict[str, Callable[[], Mapping[str, bytes]]] = {
    "": dict,
    "foreign_logs": foreign_logs,
    "testbed_trials": testbed_trials,
    "path_points": lambda: {"path.csv": PATH_POINTS.encode()},
    "topics": lambda: {"topics.yaml": TOPICS.encode()},
}

CASES = tuple(
    Case(
        name,
        tuple(entry.get("steps", ())),
        MAKERS[entry.get("make", "")],
        ("", *COMMANDS) if entry.get("helps") else (),
    )
    for name, entry in read_yaml(Path(__file__).with_suffix(".yaml")).items()
)
"""All cases."""
