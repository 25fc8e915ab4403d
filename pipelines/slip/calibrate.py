"""A robot's description, the odometry of a tracked one, or the soil of a wheel testbed, from logs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipelines.slip.modes import CalibrateSettings as Settings
from pipelines.slip.modes import OdometrySettings, RobotSettings, SoilSettings, refuse_others
from terrain.errors import ConfigError

if TYPE_CHECKING:
    from pipelines.report import Progress, Result
    from pipelines.report.settings import Settings as BaseSettings

EXAMPLE = "terrain calibrate --data raw/ --robot agrimaro --out mine.yaml"


def run(settings: Settings, progress: Progress) -> Result:
    """Calibrate, and write what was found.

    Raises
    ------
    ConfigError
        if an option is missing or for something else, or a file is there already.
    LogError
        if a run cannot be read.
    DataError
        if the runs do not show what is to be found.
    """
    groups: dict[str, type[BaseSettings]] = {
        "--what robot": RobotSettings,
        "--what odometry": OdometrySettings,
        "--what soil": SoilSettings,
    }
    refuse_others(settings, groups, f"--what {settings.what}", f"--what {settings.what}")
    if settings.what == "soil":
        from pipelines.slip.soil import calibrate_soil

        if settings.robot is not None:
            raise ConfigError("--robot: a soil is found from trials that name their wheels; leave it out")
        return calibrate_soil(settings, progress)
    if settings.robot is None:
        raise ConfigError(f"--robot is missing: --what {settings.what} starts from one")
    if settings.figures is not None:
        raise ConfigError(f"--figures is for --what soil, not for --what {settings.what}")
    if settings.what == "odometry":
        from pipelines.slip.odometry import calibrate_odometry

        return calibrate_odometry(settings, settings.robot, progress)
    from pipelines.slip.robot import calibrate_robot

    return calibrate_robot(settings, settings.robot)
