import numpy as np
import pytest

from terrain.kinematics import omni
from terrain.kinematics.wheel_speed import with_wheel_speeds
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot

ROBOTINO = load_robot("robotino")
LENGTH_S = 9.0


@pytest.fixture(scope="session")
def omni_run():
    """Return what makes a run at 0.1 m/s in one direction, by its slip and currents, seen by a camera above."""

    def make(rng, run_id, terrain, direction, slip, current_a, session="", noise=(0.0, 0.0)):
        time_s = np.arange(0.0, LENGTH_S, 0.031)
        twist = 0.1 * np.array([np.cos(direction), np.sin(direction), 0.0])
        wheels = omni.inverse(ROBOTINO.wheel_positions_m, ROBOTINO.wheel_directions_rad, twist)
        flat = np.zeros((time_s.size, 3))
        travelled = np.cumsum(0.1 * (1 - np.asarray(slip)) * np.ones(time_s.size)) * 0.031
        pose = np.column_stack(
            [travelled * np.cos(direction), travelled * np.sin(direction), np.zeros(time_s.size)]
        )
        pose += rng.normal(0.0, 0.0005, pose.shape)
        current = flat + np.reshape(current_a, (-1, 1)) + rng.normal(0.0, noise[0], flat.shape)
        rates = flat + ROBOTINO.logged_rates(wheels) + rng.normal(0.0, noise[1], flat.shape)
        channels = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
        commanded = ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
        streams = {
            "wheels": Stream(time_s, np.hstack([rates, current]), channels),
            "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
            "commands": Stream(time_s, np.tile(twist, (time_s.size, 1)), commanded),
        }
        labels = (Label(0.0, LENGTH_S, terrain),) if terrain else ()
        return with_wheel_speeds(RunLog(run_id, "robotino", streams, labels, session=session), ROBOTINO)

    return make
