"""What a network sees of a window: the spectrogram of each stream at its own rate, or its samples.

Each stream has a branch of its own; nothing is resampled.  Of a stream that is fast enough for a spectrum,
the branch sees the spectrogram of each channel, of a slow one the samples:

- ``S_cft = log(|sum_u w_u (x_c,ht+u - m_c) exp(-2 pi i f u / F)|^2 + e_c)`` with frames of ``F`` samples
  every ``h``, a Hann window w, the window's mean m and a floor e, which keeps a channel at rest from
  deciding by its rounding;
- both are standardised by training windows and clipped.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from terrain.errors import DataError
from terrain.records import Array

FRAME_S = 0.4
HOP_S = 0.1
MIN_FRAME = 16
"""A stream with fewer samples in a frame is slow: the network sees its samples, not their spectrum."""

FLOOR_RATIO = 1e-4
"""The floor of a spectrogram as a fraction of the channel's mean power in training windows."""

CLIP_STD = 5.0


class SampleColumns(NamedTuple):
    """Consecutive columns of a matrix that are the samples of a stream, channel by channel.

    Parameters
    ----------
    stream : its name
    channels : in the order of the columns
    rate_hz : of the stream
    n_samples : of each channel in a window
    """

    stream: str
    channels: tuple[str, ...]
    rate_hz: float
    n_samples: int

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.channels) * self.n_samples

    @property
    def frame(self) -> int:
        """Samples in a frame of the spectrogram; 0 where the stream is too slow, or the window too short."""
        frame = 2 * round(FRAME_S * self.rate_hz / 2)
        return frame if MIN_FRAME <= frame <= self.n_samples else 0

    @property
    def hop(self) -> int:
        """Samples from frame to frame."""
        return max(1, round(HOP_S * self.rate_hz))


class Branch(NamedTuple):
    """How one stream is standardised.

    Parameters
    ----------
    floor : (c,) added to the power of each channel
    mean, std : (c, f) of each channel and frequency in training windows; f = 1 of samples
    """

    floor: Array
    mean: Array
    std: Array


def streams_of(columns: Sequence[SampleColumns], samples: Array) -> Iterator[Array]:
    """Yield each stream's samples (n, channels, samples) out of the columns of a matrix.

    Raises
    ------
    DataError
        if there are not as many columns.
    """
    width = sum(each.width for each in columns)
    if samples.ndim != 2 or samples.shape[1] != width:
        raise DataError(f"samples have the shape {samples.shape}, (n, {width}) is needed")
    place = 0
    for each in columns:
        part = samples[:, place : place + each.width]
        yield part.reshape(len(samples), len(each.channels), each.n_samples)
        place += each.width


def power_spectrogram(values: Array, frame: int, hop: int) -> Array:
    """Return the power (n, c, f, frames) of frequencies 1 to ``frame / 2`` of samples (n, c, samples).

    Examples
    --------
    >>> wave = np.sin(2 * np.pi * 10 * np.arange(200) / 100)[None, None]
    >>> power = power_spectrogram(wave, 40, 10)
    >>> power.shape, int(power[0, 0, :, 8].argmax()) + 1  # 10 Hz are four periods in a frame
    ((1, 1, 20, 17), 4)
    """
    centred = values - values.mean(axis=2, keepdims=True)
    frames = np.ascontiguousarray(sliding_window_view(centred, frame, axis=2)[:, :, ::hop])
    squares = frames @ fourier_kernel(frame).astype(values.dtype)
    np.square(squares, out=squares)
    half = frame // 2
    return np.asarray((squares[..., :half] + squares[..., half:]).swapaxes(2, 3))


@cache
def fourier_kernel(frame: int) -> Array:
    """Return the windowed cosines and sines (frame, frame) of frequencies 1 to ``frame / 2``."""
    time = np.arange(frame)
    angle = 2 * np.pi * np.outer(time, np.arange(1, frame // 2 + 1)) / frame
    waves = np.concatenate([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.hanning(frame)[:, None] * waves)


def seen(columns: SampleColumns, values: Array, floor: Array) -> Array:
    """Return what a branch sees before it is standardised (n, c, f, t): the spectrogram, or the samples."""
    if not columns.frame:
        return values[:, :, None]
    power = power_spectrogram(values, columns.frame, columns.hop)
    return np.asarray(np.log(power + floor[:, None, None]))


def standardised(branch: Branch, found: Array) -> Array:
    """Return what a branch sees, standardised and clipped, as the rows of a convolution (n, c f, t)."""
    scaled = found - branch.mean[:, :, None]
    scaled /= branch.std[:, :, None]
    return np.clip(scaled, -CLIP_STD, CLIP_STD, out=scaled).reshape(len(found), -1, found.shape[3])


def log_softmax(logits: Array) -> Array:
    """Return log probabilities along the last axis."""
    shifted = logits - logits.max(axis=-1, keepdims=True)
    return np.asarray(shifted - np.log(np.exp(shifted).sum(axis=-1, keepdims=True)))


def softmax(logits: Array) -> Array:
    """Return probabilities along the last axis.

    Examples
    --------
    >>> softmax(np.array([0.0, 0.0]))
    array([0.5, 0.5])
    """
    return np.asarray(np.exp(log_softmax(logits)))
