"""Whether streams come."""

import numpy as np

from terrain.estimation.clocks import StreamHealth
from terrain.records import Reading


def test_a_stream_that_ended_before_the_clock_was_set_back_is_lost():
    health = StreamHealth({"imu": ("gyro_z_radps",), "wheels": ("speed_left_mps",)})
    reading = Reading(np.array([0.0]), np.array([[0.1]]))
    health.take({"imu": reading, "wheels": reading}, 5000.0)
    for k in range(20):
        health.take({"imu": reading}, 1000.0 + 0.1 * k)
    assert health.health(1002.0) == {"imu": "fresh", "wheels": "lost"}
