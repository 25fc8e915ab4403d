"""Control of every drive in a loop with a small robot of it: the laws that hold for all."""

import math

import numpy as np
import pytest

from terrain.control.path_tracking import check_tracking, tracking_of
from terrain.control.robot_control import PilotSettings, RobotControl, check_pilot
from terrain.control.slip_table import load_slip_table
from terrain.control.switching import OutputStatus, TerrainBelief
from terrain.control.turning import SETTINGS as TURN
from terrain.errors import ConfigError
from terrain.estimation.health import Health
from terrain.estimation.live import LiveEstimate
from terrain.records import Reading
from terrain.robots import SkidSteerRobot, load_robot
from terrain.slip import slip_ratio

DT_S, SUBSTEPS, G = 0.02, 4, 9.81
STATES = ("position_x_m", "position_y_m", "yaw_rad")


class RollingRobot:
    """A robot of any drive, at rest at the origin, on ground that holds its wheels by friction.

    Wheels follow their commands by a lag.  A contact is pushed by the velocity at which it slips, along the wheel by
    the curve ``mu N tanh(s / s_0)`` of its slip, and across it alike where it has no rollers; what resists is a part of
    the load.  ``mu`` and ``s_0`` are of each wheel, or of all.  Its estimate is the truth.
    """

    def __init__(self, robot, mu=0.6, s_0=0.1, resistance=0.05, lag_s=0.08, delay=2):
        self.robot, n = robot, len(robot.wheels)
        self.mu, self.s_0 = np.full(n, mu, float) * 1.0, np.full(n, s_0, float) * 1.0
        self.resistance, self.lag_s, self.delayed = resistance, lag_s, [None] * delay
        ends = (0.5, -0.5) if robot.skids else (0.0,)
        self.contacts = [
            (i, x_m + end * robot.wheelbase_m, y_m)
            for i, (x_m, y_m) in enumerate(robot.wheel_positions_m.tolist())
            for end in ends
        ]
        self.pose, self.motion, self.accel = np.zeros(3), np.zeros(3), np.zeros(3)
        self.wheel_mps, self.steer_rad, self.time_s = np.zeros(n), np.zeros(n), 0.0
        places = np.array([c[1:] for c in self.contacts])
        self.com = places.mean(axis=0)
        self.inertia = robot.mass_kg * max(float(np.square(places - self.com).sum(axis=1).mean()), 0.01)
        self.driven = np.isin(robot.wheels, robot.logged_wheels)

    def estimate(self):
        """Return the truth as an estimate."""
        nan, n = math.nan, len(self.wheel_mps)
        ground = self.ground()
        return LiveEstimate(
            self.time_s,
            self.pose.copy(),
            np.full(3, 1e-3),
            np.where(self.driven, slip_ratio(self.wheel_mps, ground), nan),
            np.full(n, 0.01),
            False,
            0.0,
            np.full(32, nan),
            float(self.motion[0]),
            float(self.motion[1]) if self.robot.sideways else nan,
            float(self.motion[2]),
            float(self.accel[0]),
            float(self.accel[1]),
            np.full(n, nan),
            np.full(n, nan),
            np.where(self.driven, self.wheel_mps, nan),
            np.empty(0, np.int8),
        )

    def ground(self):
        """Return the speed (wheels,) over ground along each wheel, or the axis of its rollers."""
        robot, (v_x, v_y, turn) = self.robot, self.motion
        angle = robot.wheel_directions_rad + self.steer_rad + robot.roller_angles_rad
        x_m, y_m = robot.wheel_positions_m.T
        along = (v_x - turn * y_m) * np.cos(angle) + (v_y + turn * x_m) * np.sin(angle)
        return along / np.cos(robot.roller_angles_rad)

    def step(self, command):
        """Drive on for one period of the control."""
        self.delayed.append(command)
        command = self.delayed.pop(0)
        for _ in range(SUBSTEPS):
            self._move(command, DT_S / SUBSTEPS)
        self.time_s += DT_S

    def _move(self, command, dt_s):
        robot, force = self.robot, np.zeros(3)
        if command is not None:
            desired = command.wheel_radps * robot.wheel_radius_m
            self.wheel_mps += (desired - self.wheel_mps) * dt_s / self.lag_s
            self.steer_rad += (command.steer_rad - self.steer_rad) * dt_s / self.lag_s
        load = robot.mass_kg * G / len(self.contacts)
        v_x, v_y, turn = self.motion
        for i, x_m, y_m in self.contacts:
            roller = float(robot.roller_angles_rad[i])
            rolls_across = robot.on_omni_wheels
            angle = float(robot.wheel_directions_rad[i] + self.steer_rad[i]) + roller
            cos, sin = math.cos(angle), math.sin(angle)
            p_x, p_y = v_x - turn * y_m, v_y + turn * x_m
            along, across = p_x * cos + p_y * sin, p_y * cos - p_x * sin
            wheel = float(self.wheel_mps[i]) * math.cos(roller) if self.driven[i] else along
            slides = math.hypot(wheel - along, 0.0 if rolls_across else across)
            fastest = max(abs(wheel), math.hypot(along, across), 0.05)
            push = self.mu[i] * load * math.tanh(slides / fastest / self.s_0[i]) / max(slides, 1e-9)
            pull = push * (wheel - along) - self.resistance * load * math.tanh(along / 0.02)
            side = 0.0 if rolls_across else -push * across
            f_x, f_y = cos * pull - sin * side, sin * pull + cos * side
            force += [f_x, f_y, (x_m - self.com[0]) * f_y - (y_m - self.com[1]) * f_x]
        # velocity of the centre of mass, in body axes
        com_x, com_y = self.com
        centre = np.array([v_x - turn * com_y, v_y + turn * com_x])
        accel = force[:2] / robot.mass_kg
        centre += dt_s * (accel + turn * np.array([centre[1], -centre[0]]))
        turn += dt_s * force[2] / self.inertia
        self.accel = np.array([*accel, 0.0])
        self.motion = np.array([centre[0] + turn * com_y, centre[1] - turn * com_x, turn])
        yaw = self.pose[2]
        v_x, v_y = self.motion[:2]
        moved = math.cos(yaw) * v_x - math.sin(yaw) * v_y, math.sin(yaw) * v_x + math.cos(yaw) * v_y
        self.pose = self.pose + dt_s * np.array([*moved, turn])


NAMES = ("husky", "marmotte", "robotino", "omnirobot", "adap2e", "pallet_truck")
BARE = SkidSteerRobot("mine", 0.165, 0.57, 0.512, 50.0)
ROBOTS = {name: load_robot(name) for name in NAMES} | {"mine": BARE}
BELIEF = TerrainBelief("grass", 1.0)
SLICK = {"mu": 0.4, "s_0": 0.25}
every_drive = pytest.mark.parametrize("robot", ROBOTS.values(), ids=list(ROBOTS))
turning_by_wheels = pytest.mark.parametrize("name", ["husky", "marmotte", "omnirobot"])


def control(robot, controller="traction", track=False, follows=True):
    channels = {"wheels": robot.rate_channels}
    states = () if controller in ("plain", "ramp") else STATES
    return RobotControl(
        robot, load_slip_table(), PilotSettings(controller, track=track, follows=follows), states, channels
    )


def drive(robot, twist, controller="traction", length_s=8.0, track=False, push=None, **ground):
    """Rows (n, 8) of a drive: time, speed, yaw rate, x, y, yaw, mean slip of the driven wheels, driven speed."""
    plant, rows = RollingRobot(robot, **ground), []
    pilot = control(robot, controller, track)
    while plant.time_s < length_s:
        if push is not None:
            push(plant)
        desired = np.array(twist(plant.time_s) if callable(twist) else twist, float)
        seen = None if controller in ("plain", "ramp") else plant.estimate()
        now = plant.time_s, DT_S, desired, seen, BELIEF, OutputStatus.NONE
        command, _ = pilot.step(*now, holds=True)
        assert all(np.isfinite(row).all() for row in command[:3])
        assert command.wheel_radps.shape == command.steer_rad.shape == (len(robot.wheels),)
        plant.step(command)
        u, g = plant.wheel_mps[plant.driven], plant.ground()[plant.driven]
        slip = np.mean(np.abs(u - g) / np.maximum(np.maximum(abs(u), abs(g)), 0.05))
        pose, driven = plant.pose.tolist(), command.status["driven_mps"]
        rows.append([plant.time_s, float(plant.motion[0]), float(plant.motion[2]), *pose, slip, driven])
    return np.array(rows)


def ramped(*twist, accel=1.0):
    return lambda time_s: np.array(twist) * min(max(time_s - 0.3, 0.0) * accel, 1.0)


@every_drive
def test_plain_commands_are_those_of_the_kinematics_and_traction_drives_as_far(robot):
    plain, limited = (drive(robot, ramped(0.4, 0.0, 0.0), name, **SLICK) for name in ("plain", "traction"))
    assert limited[-1, 3] > 0.9 * plain[-1, 3]
    assert limited[-1, 1] == pytest.approx(plain[-1, 1], rel=0.05)  # cruising, nothing is held back


@every_drive
def test_a_hard_start_on_slick_ground_slips_less(robot):
    step = ramped(0.6, 0.0, 0.0, accel=20.0)
    plain, limited = (drive(robot, step, name, mu=0.25, s_0=0.2) for name in ("plain", "traction"))
    moving = [rows[:, 1] > 0.2 for rows in (plain, limited)]
    peaks = [rows[fast, 6].max() for rows, fast in zip((plain, limited), moving, strict=True)]
    assert peaks[1] < 0.8 * peaks[0]
    assert limited[-1, 3] > 0.85 * plain[-1, 3]


@pytest.mark.parametrize("name", ["husky", "omnirobot"])
def test_a_start_on_hard_ground_slips_less_than_the_constant_rise_that_travels_as_far(name):
    """Slip follows from the acceleration there: without the first step no other rise is better than a constant one."""

    def start(controller, rise):
        rows = drive(ROBOTS[name], ramped(0.6, 0.0, 0.0, accel=rise / 0.6), controller, mu=0.3, s_0=0.1)
        return rows[rows[:, 1] > 0.2, 6].max(), rows[-1, 3]

    limited, travelled_m = start("traction", 4.0)
    low, high = 0.3, 4.0
    for _ in range(8):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if start("plain", middle)[1] < travelled_m else (low, middle)
    assert limited < 0.9 * start("plain", low)[0]


@every_drive
def test_where_no_slip_is_known_the_robot_is_driven_and_nothing_corrected(robot):
    pilot, command = control(robot), None
    for k in range(150):
        desired = np.array([0.3, 0.0, 0.0])
        command, _ = pilot.step(DT_S * k, DT_S, desired, None, BELIEF, OutputStatus.NONE, holds=True)
    assert command.twist == pytest.approx([0.3, 0.0, 0.0])
    assert command.status["status_code"] != 0.0


@every_drive
def test_a_command_to_stand_is_no_motion(robot):
    pilot = control(robot)
    command, _ = pilot.step(0.0, DT_S, np.zeros(3), RollingRobot(robot).estimate(), BELIEF, OutputStatus.NONE)
    assert not command.wheel_radps.any()
    assert not command.twist.any()


TWISTS = ((0.6, 0.0, 0.3), (0.6, 0.0, 0.0), (0.3, 0.0, -0.6), (-0.4, 0.0, 0.3))


@pytest.mark.parametrize(  # the last two are beyond what such ground gives tracks
    ("name", "twist"),
    [
        *(
            (name, twist)
            for name, n in (("husky", 4), ("marmotte", 2), ("omnirobot", 4))
            for twist in TWISTS[:n]
        ),
        *(
            (name, twist)
            for name in ("adap2e", "pallet_truck")
            for twist in ((0.6, 0.0, 0.1), (-0.5, 0.0, 0.1))
        ),
    ],
)
def test_the_commanded_turn_is_kept_while_a_side_slips_more(name, twist):
    robot = ROBOTS[name]
    n = len(robot.wheels)
    mu, s_0 = np.full(n, 0.5), np.full(n, 0.15)
    mu[0], s_0[0] = 0.4, 0.3
    plain, kept = (drive(robot, ramped(*twist), c, mu=mu, s_0=s_0) for c in ("plain", "traction"))
    late = kept[:, 0] > 5.0
    most = max(0.05 * abs(twist[2]), 0.01)
    assert np.abs(kept[late, 2] - twist[2]).max() < most
    assert abs(plain[-1, 2] - twist[2]) > 1.4 * abs(kept[-1, 2] - twist[2])


@turning_by_wheels
def test_a_sensor_that_comes_and_goes_turns_no_robot(name, monkeypatch):
    pilot, turned = control(ROBOTS[name]), []
    seen = RollingRobot(ROBOTS[name]).estimate()._replace(yaw_rate_radps=0.2)
    for k in range(150):
        lost = (k < 50 and k % 15 == 0) or k == 100
        monkeypatch.setattr(
            pilot, "_judge", lambda _, lost=lost: (0, Health.LOST) if lost else (-1, Health.FRESH)
        )
        now = DT_S * k, DT_S, np.array([0.5, 0.0, 0.0]), seen, BELIEF, OutputStatus.NONE
        turned.append(bool(pilot.step(*now)[0].twist[2]))
    assert not any(turned[:70])
    assert all(turned[71:100])
    assert not any(turned[100:124])
    assert all(turned[126:])


@turning_by_wheels
def test_a_replayed_log_winds_nothing_up(name):
    """Another controller drives: what is left of its turn is no error of these commands."""
    robot, twist = ROBOTS[name], np.array([0.4, 0.0, 0.4])
    plant, other = RollingRobot(robot, **SLICK), control(robot, "plain")
    replayed = control(robot, follows=False)
    for _ in range(500):
        seen = plant.estimate()
        now = plant.time_s, DT_S, twist
        plant.step(other.step(*now, None, BELIEF, OutputStatus.NONE, holds=True)[0])
        command, _ = replayed.step(*now, seen, BELIEF, OutputStatus.NONE, holds=True)
    rolled = float(np.linalg.pinv(replayed._turning.rolling)[2] @ plant.wheel_mps)
    ratio = rolled / plant.motion[2] if robot.skids else 1.0
    answer = ratio * (twist[2] + TURN.k_p * (twist[2] - plant.motion[2]))
    assert command.twist[2] / command.twist[0] == pytest.approx(answer / twist[0], rel=0.05)


@turning_by_wheels
def test_a_turn_on_the_spot_turns_as_desired(name):
    kept = drive(ROBOTS[name], ramped(0.0, 0.0, 0.6))
    assert kept[-1, 2] == pytest.approx(0.6, rel=0.03)
    assert math.hypot(*kept[-1, 3:5]) < 0.2


@pytest.mark.parametrize("name", ["husky", "marmotte", "adap2e", "omnirobot"])
def test_path_tracking_brings_a_robot_back_that_was_pushed_aside(name):
    def push(plant):
        if abs(plant.time_s - 2.0) < 0.5 * DT_S:
            plant.pose[2] += 0.015

    robot, ground = ROBOTS[name], {"mu": 0.6, "s_0": 0.1}
    off, kept = (
        drive(robot, ramped(0.6, 0.0, 0.0), track=track, push=push, length_s=14.0, **ground)
        for track in (False, True)
    )
    assert abs(off[-1, 4]) > 0.1
    assert abs(kept[-1, 4]) < 0.02
    assert abs(kept[-1, 5]) < 0.005


@every_drive
def test_path_tracking_is_stable_on_every_robot_and_refused_without_a_pose(robot):
    check_tracking(robot, tracking_of(robot))
    table, settings = load_slip_table(), PilotSettings(track=True)
    channels = {"wheels": robot.rate_channels}
    with pytest.raises(ConfigError, match="estimates no pose"):
        RobotControl(robot, table, settings, ("speed_mps",), channels)
    with pytest.raises(ConfigError, match="must be among them"):
        RobotControl(robot, table, settings, STATES, {"wheels": ("current_1_a",)})


@every_drive
def test_a_wheel_that_does_not_follow_is_not_believed(robot):
    pilot, readings = control(robot), {}
    check_pilot(robot, load_slip_table(), PilotSettings())
    plant = RollingRobot(robot)
    for k in range(60):
        time_s = DT_S * k
        values = np.zeros((1, len(robot.rate_channels)))  # it stands
        readings = {"wheels": Reading(np.array([time_s]), values)}
        pilot.measured(time_s, DT_S, readings, plant.estimate())
        command, _ = pilot.step(
            time_s, DT_S, np.array([0.5, 0.0, 0.0]), plant.estimate(), BELIEF, OutputStatus.NONE
        )
    stands = np.isclose(command.wheel_radps[np.isin(robot.wheels, robot.logged_wheels)], 0.0)
    assert np.isnan(readings["wheels"].values[0]).tolist() == [not one for one in stands]
    assert command.status["health_code"] > 2.0
