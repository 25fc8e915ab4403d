import numpy as np
import pytest

from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import rolling_matrix
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot


@pytest.fixture(scope="session")
def robotino():
    return load_robot("robotino")


@pytest.fixture(scope="session")
def make_omni_run(robotino):
    """Return a function that logs an omni robot which slips alike in all directions, under a camera."""

    def make(
        rng=None,
        twist=(0.08, 0.06, 0.0),
        slip=0.2,
        length_s=10.0,
        start_s=0.0,
        delay_s=0.0,
        heading=0.4,
        noise_m=0.0005,
        current_a=0.5,
        run_id="cork_1",
        terrain="cork",
        slip_after=None,
        change_s=np.inf,
    ):
        rng = np.random.default_rng(0) if rng is None else rng
        fine = np.arange(0.0, length_s + 2.0, 0.001)
        going = np.clip((fine - start_s) / 0.2, 0.0, 1.0)
        slips = np.where(fine < change_s, slip, slip if slip_after is None else slip_after)
        yaw = heading + np.cumsum(going * (1 - slips) * twist[2]) * 0.001
        step = np.exp(1j * yaw) * complex(twist[0], twist[1]) * going * (1 - slips) * 0.001
        place = np.cumsum(step)
        time_s = np.arange(0.0, length_s, 0.031)
        seen_s = np.maximum(time_s - delay_s, 0.0)
        pose = np.column_stack([np.interp(seen_s, fine, part) for part in (place.real, place.imag, yaw)])
        pose += rng.normal(0.0, 1.0, pose.shape) * [noise_m, noise_m, 8 * noise_m]
        wheels = np.array(twist) @ rolling_matrix(robotino.wheel_positions_m, robotino.wheel_directions_rad).T
        rates = np.interp(time_s, fine, going)[:, None] * robotino.logged_rates(wheels)
        rates += rng.normal(0.0, 0.5 if noise_m else 0.0, rates.shape)
        currents = current_a + 0.02 * rng.normal(size=rates.shape)
        channels = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
        streams = {
            "wheels": Stream(time_s, np.hstack([rates, currents]), channels),
            "pose": Stream(time_s, pose, ("position_x_m", "position_y_m", "yaw_rad")),
        }
        labels = (Label(0.0, length_s, terrain),) if terrain else ()
        return with_wheel_speeds(RunLog(run_id, "robotino", streams, labels), robotino)

    return make
