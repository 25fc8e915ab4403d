"""Efficiency of tracks: speed over ground of a track over its circumferential speed, and its slip.

``n = V_t / v``, and ``1 - n`` is the slip of Tazzari et al. (6).  The slip of this project divides by the
larger of the two speeds (:mod:`terrain.slip`), so that of a track that brakes, n > 1, is ``1 / n - 1``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from terrain.records import Array
from terrain.slip import MIN_SPEED_MPS


def measured_efficiency(
    forward_mps: Any,
    yaw_rate_radps: Any,
    left_mps: Any,
    right_mps: Any,
    half_track_m: float,
    min_speed_mps: float = MIN_SPEED_MPS,
) -> Array:
    """Return the efficiency of the left and the right track, (..., 2), from speeds that are measured.

    (4) and (15): ``n_R = (V_G + d Omega) / v_R``, ``n_L = (V_G - d Omega) / v_L``; NaN of a track that is
    slower than ``min_speed_mps``.

    Parameters
    ----------
    forward_mps : speed over ground along the body, from satellites
    yaw_rate_radps : of a gyro
    left_mps, right_mps : circumferential speeds of the tracks
    half_track_m : d
    min_speed_mps : of a track

    Examples
    --------
    >>> measured_efficiency(0.46, 0.04, [0.4, 0.0], 0.6, half_track_m=0.5)
    array([[1.1, 0.8], [nan, 0.8]])
    """
    forward, turn, left, right = np.broadcast_arrays(
        *(np.asarray(v, float) for v in (forward_mps, yaw_rate_radps, left_mps, right_mps))
    )
    tracks = np.stack([left, right], axis=-1)
    ground = np.stack([forward - half_track_m * turn, forward + half_track_m * turn], axis=-1)
    efficiency = np.full(tracks.shape, np.nan)
    np.divide(ground, tracks, out=efficiency, where=np.abs(tracks) >= min_speed_mps)
    return efficiency


def traction_slip_of(efficiency: Any) -> Array:
    """Return the slip ratio of an efficiency, positive in traction: ``(1 - n) / max(1, |n|)``.

    Examples
    --------
    >>> traction_slip_of([0.8, 1.0, 1.25])
    array([ 0.2,  0. , -0.2])
    """
    n = np.asarray(efficiency, float)
    return np.asarray((1.0 - n) / np.maximum(1.0, np.abs(n)))
