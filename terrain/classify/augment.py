"""Variations of measured windows that leave the terrain as it is: a network trains on more than was measured.

Each is one that the physics allows: a window might have begun earlier, the ground might shake
the robot more, it might have driven the mirror image of its path, a sensor might have failed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from terrain.classify.network_input import SampleColumns
from terrain.records import Array

GAIN_STD = 0.5
"""Standard deviation of the logarithm of the amplitude of vibration: assumed."""

DROPOUT_RATIO = 0.1
"""How often a stream is taken for failed."""

TURNED = {"gyro": "xz", "accel": "y", "speed": "y", "position": "y", "velocity": "y", "odometry": "y"}
"""Axes along which a quantity changes its sign in the mirror; x points ahead, y to the left."""

TURNED_WORDS = frozenset({"roll", "yaw", "lateral"})


class Augmentation(NamedTuple):
    """Which variations are used.

    Parameters
    ----------
    shift : of the window, its end continued by its beginning
    gain : of the vibration in a window, log-normal, one for all channels of a stream that is fast enough to
        hold it: speed, load and tyres shake all axes; what a slow stream measures stays as it is
    mirror : half of the windows, left for right
    dropout : a stream at its training mean, in a window out of ten
    """

    shift: bool = False
    gain: bool = False
    mirror: bool = False
    dropout: bool = False


class Mirror(NamedTuple):
    """Where each channel's mirror image is among the channels, and its sign."""

    places: tuple[int, ...]
    signs: tuple[float, ...]


def mirror_of(channels: Sequence[str]) -> Mirror | None:
    """Return the left-right mirror of a stream's channels; None where names do not give it.

    Wheels with numbers have places that only the robot's description knows.

    Examples
    --------
    >>> mirror_of(("gyro_z_radps", "accel_x_mps2", "accel_y_mps2"))
    Mirror(places=(0, 1, 2), signs=(-1.0, 1.0, -1.0))
    >>> mirror_of(("speed_left_mps", "speed_right_mps"))
    Mirror(places=(1, 0), signs=(1.0, 1.0))
    >>> mirror_of(("motor_1_radps",)) is None
    True
    """
    places, signs = [], []
    for name in channels:
        words = name.split("_")
        image = "_".join({"left": "right", "right": "left"}.get(word, word) for word in words)
        if image not in channels or any(word.isdigit() for word in words):
            return None
        turned = bool(TURNED_WORDS & set(words)) or any(
            axis in words[1:] for axis in TURNED.get(words[0], "")
        )
        places.append(list(channels).index(image))
        signs.append(-1.0 if turned else 1.0)
    return Mirror(tuple(places), tuple(signs))


def mirrors_of(columns: Sequence[SampleColumns]) -> tuple[Mirror, ...] | None:
    """Return the mirror of all streams; None where one of them has none."""
    mirrors = [mirror_of(each.channels) for each in columns]
    return None if None in mirrors else tuple(each for each in mirrors if each is not None)


def augmented(
    streams: Sequence[Array],
    means: Sequence[Array],
    used: Augmentation,
    mirrors: Sequence[Mirror] | None,
    vibrates: Sequence[bool],
    rng: np.random.Generator,
) -> list[Array]:
    """Return varied windows, each with its own draw; the same draw in all streams where time or sides are.

    Parameters
    ----------
    streams : (n, channels, samples) of each
    means : (channels,) of each stream in training windows
    used : variations; without mirrors there is no mirror image
    mirrors : of each stream
    vibrates : of each stream, whether it is fast enough to hold vibration
    rng : source of the draws
    """
    n = len(streams[0])
    found = list(streams)
    if used.shift:
        fraction = rng.random(n)
        for i, values in enumerate(found):
            length = values.shape[2]
            begins = sliding_window_view(np.concatenate([values, values], axis=2), length, axis=2)
            found[i] = begins[np.arange(n), :, (fraction * length).astype(int)]
    if used.gain:
        gains = [np.exp(GAIN_STD * fast * rng.standard_normal((n, 1, 1))) for fast in vibrates]
        found = [values * gain.astype(values.dtype) for values, gain in zip(found, gains, strict=True)]
    if used.mirror and mirrors is not None:
        turned = np.flatnonzero(rng.random(n) < 0.5)
        for i, (values, mirror) in enumerate(zip(found, mirrors, strict=True)):
            image = values[turned][:, list(mirror.places)] * np.array(mirror.signs, values.dtype)[:, None]
            found[i] = _with_rows(values, turned, image)
    if used.dropout and len(found) > 1:
        failed = rng.random(n) < DROPOUT_RATIO
        which = rng.integers(len(found), size=n)
        for i, (values, mean) in enumerate(zip(found, means, strict=True)):
            found[i] = _with_rows(values, np.flatnonzero(failed & (which == i)), mean[:, None])
    return found


def _with_rows(values: Array, rows: Array, others: Array) -> Array:
    """Return values (n, ...) with others in the place of some rows."""
    found = values.copy()
    found[rows] = others
    return found
