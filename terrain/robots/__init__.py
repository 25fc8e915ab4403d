"""Robots: one type a drive, the sections of their descriptions, and the reader of those."""

from terrain.robots.bicycle import BicycleRobot
from terrain.robots.omni import OmniRobot
from terrain.robots.parts import Body, Camera, Equipment, Motors, Part, Sensors, Steering
from terrain.robots.reader import (
    description_file,
    load_robot,
    packaged_robot,
    read_description,
    robot_from,
    robot_named,
)
from terrain.robots.region import Region
from terrain.robots.robot import Robot, as_drive
from terrain.robots.skid_steer import SkidSteerRobot
from terrain.robots.swerve import SwerveRobot
from terrain.robots.tracked import TrackedRobot

__all__ = [
    "BicycleRobot",
    "Body",
    "Camera",
    "Equipment",
    "Motors",
    "OmniRobot",
    "Part",
    "Region",
    "Robot",
    "Sensors",
    "SkidSteerRobot",
    "Steering",
    "SwerveRobot",
    "TrackedRobot",
    "as_drive",
    "description_file",
    "load_robot",
    "packaged_robot",
    "read_description",
    "robot_from",
    "robot_named",
]
