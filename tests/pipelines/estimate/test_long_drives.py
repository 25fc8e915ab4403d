"""Long drives: the yaw stays at the truth, the seed alone decides, one that is too short is refused."""

import io

import pytest
from rich.console import Console

from pipelines.estimate.long_drives import drive_long, drives_long, print_drives
from terrain.errors import ConfigError
from terrain.robots import load_robot

ROBOT = load_robot("agrimaro")


@pytest.mark.slow
def test_yaw_and_uncertainty_of_drives_of_several_minutes():
    drives = drives_long(ROBOT, 21, 2, 200.0, n_jobs=1)
    assert [drive.terrain for drive in drives] == ["asphalt", "clay"]
    for drive in drives:
        assert 0.0 < drive.yaw_error_rad < 0.02
        assert 0.0 < drive.blind_yaw_error_rad < 0.1
        assert 0.85 < drive.slip_coverage <= 1.0
    assert drive_long(ROBOT, "clay", 21, 2, 200.0) == drives[1]
    with Console(file=io.StringIO(), width=120) as console:
        print_drives(drives, console)
    assert "largest, mean" in console.file.getvalue()


def test_a_drive_without_a_minute_before_the_loss_is_refused():
    with pytest.raises(ConfigError, match="too short"):
        drive_long(ROBOT, "grass", 0, 1, 90.0)


@pytest.mark.slow
def test_yaw_of_drives_of_half_an_hour():
    drives = drives_long(ROBOT, 22, 4, 1800.0)
    assert max(drive.yaw_error_rad for drive in drives) < 0.02
    assert max(drive.blind_yaw_error_rad for drive in drives) < 0.1
