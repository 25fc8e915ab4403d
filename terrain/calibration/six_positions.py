"""Accelerometer in six positions: bias and scale of each axis (Danzi, AgriMaRo thesis, 3.3.3).

Held still, in any orientation, it measures gravity only.  With ``a = k f + b`` an axis, the means
of the stretches fulfil::

    |(a - b) / k| = g

six unknowns, for which six positions with each axis up and down once are enough, however crooked they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from terrain.calibration.finding import Finding, biases, half_width, undetermined
from terrain.calibration.standing import ACCEL, Stretch, batches
from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.records import Array
from terrain.robots import Robot

MIN_POSITION_S = 2.0
"""Of a position: "a couple of seconds" (thesis 3.3.3)."""

UPRIGHT_SHARE = 0.8
"""An axis points up or down where it carries that much of gravity: within 37 degrees."""

BATCH_S = 0.5
"""Means over batches of this length are as good as independent: an accelerometer at rest has little
colour."""

STEPS = 50
"""Of Gauss and Newton; half a dozen do."""

LEVEL_ONLY = (
    "level standing alone cannot tell: along z a bias looks like a scale, along x and y like a tilt; "
    "hold the IMU still in six positions, each axis up and down, in one log"
)

GRAVITY = f"gravity taken for {GRAVITY_MPS2} m/s^2; on Earth it is within 0.3 % of that"


def fit_gravity(means_mps2: Array, variance: Array) -> tuple[Array, Array, Array]:
    """Return what makes gravity of the means of resting stretches.

    Parameters
    ----------
    means_mps2 : (n, 3) mean of the accelerometer in each of n positions
    variance : (n, 3) variance of the errors of the means

    Returns
    -------
    bias_mps2, scale_ratio : (3,)
    cov : (6, 6) of both, in that order

    Raises
    ------
    DataError
        if an axis was never turned both up and down.

    Examples
    --------
    >>> up = GRAVITY_MPS2 * np.vstack([np.eye(3), -np.eye(3)])
    >>> bias, scale, _ = fit_gravity(1.02 * up + 0.1, np.full((6, 3), 1e-6))
    >>> bias.round(3), scale.round(3)
    (array([0.1, 0.1, 0.1]), array([1.02, 1.02, 1.02]))
    """
    share = means_mps2 / np.linalg.norm(means_mps2, axis=1)[:, None]
    for i, axis in enumerate("xyz"):
        if share[:, i].max() < UPRIGHT_SHARE or share[:, i].min() > -UPRIGHT_SHARE:
            raise DataError(f"axis {axis} was not turned both up and down: six positions are needed")
    bias = (means_mps2.max(axis=0) + means_mps2.min(axis=0)) / 2
    scale = np.ones(3)
    for _ in range(STEPS):
        force = (means_mps2 - bias) / scale
        size = np.linalg.norm(force, axis=1)
        towards = force / size[:, None] / scale  # d|f|/da
        std = np.sqrt((towards**2 * variance).sum(axis=1))
        jacobian = -np.hstack([towards, towards * force]) / std[:, None]
        step = np.linalg.lstsq(jacobian, (GRAVITY_MPS2 - size) / std, rcond=None)[0]
        bias, scale = bias + step[:3], scale + step[3:]
        if np.abs(step).max() < 1e-12:
            break
    residual = (GRAVITY_MPS2 - size) / std
    dof = len(means_mps2) - 6
    spread = max(float(residual @ residual) / dof, 1.0) if dof else 1.0
    return bias, scale, spread * np.linalg.inv(jacobian.T @ jacobian)


def accelerometer(stretches: Sequence[Stretch], robot: Robot) -> list[Finding]:
    """Return biases and scales of the accelerometer, and how much the biases differ between power-ons.

    Parameters
    ----------
    stretches : standing, of at least :data:`MIN_POSITION_S`, of any runs; a run counts that has six positions
    robot : with sensors described
    """
    bias_names = [f"sensors.accel_bias_{axis}_mps2" for axis in "xyz"]
    scale_names = [f"sensors.accel_scale_{axis}_ratio" for axis in "xyz"]
    std_name = "sensors.accel_bias_std_mps2"
    of_run: dict[str, list[Array]] = {}
    for stretch in stretches:
        if stream := stretch.of("imu", ACCEL):
            means = np.array([batch.mean(axis=0) for batch in batches(stream, BATCH_S)])
            of_run.setdefault(stretch.run.run_id, []).append(means)
    fits = {}
    for run_id, positions in of_run.items():
        spare = sum(len(means) - 1 for means in positions)
        squares = sum(((means - means.mean(axis=0)) ** 2).sum(axis=0) for means in positions)
        try:
            fits[run_id] = fit_gravity(
                np.array([means.mean(axis=0) for means in positions]),
                np.array([squares / spare / len(means) for means in positions]),
            )
        except DataError:
            continue
    if not fits:
        return undetermined([*bias_names, *scale_names, std_name], LEVEL_ONLY)
    runs = tuple(fits)
    n = sum(len(of_run[run_id]) for run_id in runs)
    bias, scale, cov = (np.array(part) for part in zip(*fits.values(), strict=True))
    variance = np.diagonal(cov, axis1=1, axis2=2)
    described = robot.equipment.sensors.accel_bias_std_mps2
    half = half_width(np.sqrt(variance[:, 3:].mean(axis=0) / len(runs)), math.inf)
    mean = scale.mean(axis=0)
    return [
        *biases(bias_names, std_name, bias, variance[:, :3], described, n, "positions", runs),
        *(
            Finding(
                name,
                float(mean[i]),
                float(mean[i] - half[i]),
                float(mean[i] + half[i]),
                n,
                "positions",
                runs,
                GRAVITY,
            )
            for i, name in enumerate(scale_names)
        ),
    ]
