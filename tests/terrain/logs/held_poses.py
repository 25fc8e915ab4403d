"""Poses of a window as the authors of DRIVE cut and turn them."""

import numpy as np

PERIOD_S, N = 0.05, 40


def published_pose(speed_x, speed_y, yaw_rate, yaw_0, hold=2, noise=0.0, rng=None):
    """Return (40, 3) of a robot on a circle, with a scan every ``hold`` samples, kept until the next.

    Yaw is a difference of wrapped angles; positions are turned by the mean of the first five wrapped angles.
    """
    fine = np.arange(N) // hold * hold * PERIOD_S
    yaw = yaw_0 + yaw_rate * fine
    # the chord of an arc, in closed form: the integral of R(yaw) v
    start = np.exp(1j * yaw_0) * (speed_x + 1j * speed_y)
    place = start * ((np.exp(1j * yaw_rate * fine) - 1.0) / (1j * yaw_rate) if yaw_rate else fine)
    if rng is not None:
        scatter = rng.normal(0.0, noise, (N // hold, 3)).repeat(hold, axis=0)
        place, yaw = place + scatter[:, 0] + 1j * scatter[:, 1], yaw + scatter[:, 2]
    angle = np.angle(np.exp(1j * yaw))
    place = (place - place[0]) * np.exp(-1j * angle[:5].mean())
    return np.column_stack([place.real, place.imag, angle - angle[0]])
