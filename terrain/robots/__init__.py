"""Robots: one type a drive, the sections of their descriptions, and the reader of those."""

from terrain.robots.reader import (
    description_file,
    load_robot,
    packaged_robot,
    read_description,
    robot_from,
    robot_named,
)
from terrain.robots.region import Region
from terrain.robots.robot import (
    BicycleRobot,
    Body,
    Camera,
    Equipment,
    Motors,
    OmniRobot,
    Part,
    Robot,
    Sensors,
    SkidSteerRobot,
    Steering,
    SwerveRobot,
    TrackedRobot,
    as_drive,
)

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
