"""Robots: one type a drive, the sections of their descriptions, and the reader of those."""

from terrain.robots.bicycle import BicycleRobot, as_bicycle
from terrain.robots.omni import OmniRobot, as_omni
from terrain.robots.parts import Body, Camera, Equipment, Motors, Part, Sensors, Steering
from terrain.robots.reader import description_file, load_robot, packaged_robot, read_description, robot_from
from terrain.robots.region import Region
from terrain.robots.robot import Robot
from terrain.robots.skid_steer import SkidSteerRobot, as_skid_steer
from terrain.robots.swerve import SwerveRobot, as_swerve
from terrain.robots.tracked import TrackedRobot, as_tracked

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
    "as_bicycle",
    "as_omni",
    "as_skid_steer",
    "as_swerve",
    "as_tracked",
    "description_file",
    "load_robot",
    "packaged_robot",
    "read_description",
    "robot_from",
]
