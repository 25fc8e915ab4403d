"""A fitted network as plain numbers: spectrograms of each stream at its own rate, convolutions, late fusion.

Each stream has a branch of its own; nothing is resampled.  Of a stream that is fast enough for a spectrum,
the branch sees the spectrogram of each channel, of a slow one the samples:

- ``S_cft = log(|sum_u w_u (x_c,ht+u - m_c) exp(-2 pi i f u / F)|^2 + e_c)`` with frames of ``F`` samples
  every ``h``, a Hann window w, the window's mean m and a floor e, which keeps a channel at rest from
  deciding by its rounding;
- both are standardised by training windows and clipped;
- two convolutions over time, each with a rectifier; then the mean and the largest value over time; of the
  samples of a slow stream also the mean and standard deviation of each channel.

One linear layer joins all branches.  Several members, fitted with other runs held out, share the
standardisation; the mean of their log probabilities, divided by a temperature, gives the probabilities.

All is computed window by window in the same order, so that one window gives the same bytes as many.
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
WIDTH = 3
"""Of the convolutions, in frames or samples."""

ROWS_AT_ONCE = 256


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


class BranchNumbers(NamedTuple):
    """What one stream's branch computes with; K members.

    Parameters
    ----------
    floor : (c,) added to the power of each channel
    mean, std : (c, f) of each channel and frequency; f = 1 of samples
    weight_1, bias_1 : (K, h, c f, 3), (K, h) of the first convolution
    weight_2, bias_2 : (K, h, h, 3), (K, h) of the second
    """

    floor: Array
    mean: Array
    std: Array
    weight_1: Array
    bias_1: Array
    weight_2: Array
    bias_2: Array


class NetworkNumbers(NamedTuple):
    """What a fitted network computes with.

    Parameters
    ----------
    columns : :class:`SampleColumns` of each stream
    fill : (n_columns,) what a missing sample is taken for
    branches : one a stream
    head_weight, head_bias : (K, k, p), (K, k) of the layer that joins the branches
    temperature : that log probabilities are divided by
    """

    columns: tuple[SampleColumns, ...]
    fill: Array
    branches: tuple[BranchNumbers, ...]
    head_weight: Array
    head_bias: Array
    temperature: float


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


def standardised(branch: BranchNumbers, found: Array) -> Array:
    """Return what a branch sees, standardised and clipped, as the rows of a convolution (n, c f, t)."""
    scaled = found - branch.mean[:, :, None]
    scaled /= branch.std[:, :, None]
    return np.clip(scaled, -CLIP_STD, CLIP_STD, out=scaled).reshape(len(found), -1, found.shape[3])


def probabilities(numbers: NetworkNumbers, samples: Array) -> Array:
    """Return calibrated probabilities (n, k) in the order of the classes.

    Parameters
    ----------
    numbers : of the network
    samples : (n, n_columns), NaN where a sample is missing

    Raises
    ------
    DataError
        if there are not as many columns, or a sample is infinite.
    """
    return softmax(mean_log_probabilities(numbers, samples) / numbers.temperature)


def mean_log_probabilities(numbers: NetworkNumbers, samples: Array) -> Array:
    """Return the mean of the members' log probabilities (n, k); errors as of :func:`probabilities`."""
    if samples.ndim == 2 and samples.shape[1] == len(numbers.fill):
        samples = np.where(np.isnan(samples), numbers.fill, samples).astype(np.float32)
    if np.isinf(samples).any():
        raise DataError("a sample is infinite")
    found = np.empty((len(samples), numbers.head_bias.shape[1]))
    for start in range(0, len(samples), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        found[rows] = _log_probabilities(numbers, samples[rows]).mean(axis=1)
    return found


def _log_probabilities(numbers: NetworkNumbers, samples: Array) -> Array:
    pooled = []
    for columns, branch, values in zip(
        numbers.columns, numbers.branches, streams_of(numbers.columns, samples), strict=True
    ):
        rows = standardised(branch, seen(columns, values, branch.floor))
        hidden = _convolved(branch.weight_1, branch.bias_1, rows[:, None])
        hidden = _convolved(branch.weight_2, branch.bias_2, hidden)
        pooled += [hidden.mean(axis=3), hidden.max(axis=3)]
        if not columns.frame:
            shape = (len(rows), len(branch.bias_1), rows.shape[1])
            pooled += [
                np.broadcast_to(rows.mean(axis=2)[:, None], shape),
                np.broadcast_to(rows.std(axis=2)[:, None], shape),
            ]
    joined = np.concatenate(pooled, axis=2)[..., None]  # (n, K, p, 1)
    logits = (numbers.head_weight @ joined)[..., 0] + numbers.head_bias
    return np.asarray(log_softmax(logits.astype(np.float64)))


def _convolved(weight: Array, bias: Array, rows: Array) -> Array:
    """Return the rectified convolution (n, K, h, t) of rows (n, K or 1, d, t), zeros beyond the ends."""
    padded = np.pad(rows, ((0, 0), (0, 0), (0, 0), (1, 1)))
    taps = np.concatenate([padded[..., i : i + rows.shape[3]] for i in range(WIDTH)], axis=2)
    kernel = weight.transpose(0, 1, 3, 2).reshape(*weight.shape[:2], -1)
    return np.asarray(np.maximum(np.ascontiguousarray(kernel) @ taps + bias[..., None], 0))


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


def check_network(numbers: NetworkNumbers, n_classes: int) -> None:
    """Refuse numbers that do not fit each other.

    Raises
    ------
    DataError
        if a shape is another or a number is not finite.
    """
    members = len(numbers.head_bias) if numbers.head_bias.ndim else 0
    pooled = 0
    arrays: list[tuple[str, Array, tuple[int, ...]]] = []
    for columns, branch in zip(numbers.columns, numbers.branches, strict=True):
        c, hidden = len(columns.channels), max(branch.bias_1.shape, default=0)
        f = columns.frame // 2 if columns.frame else 1
        shapes = {
            "floor": (c,),
            "mean": (c, f),
            "std": (c, f),
            "weight_1": (members, hidden, c * f, WIDTH),
            "bias_1": (members, hidden),
            "weight_2": (members, hidden, hidden, WIDTH),
            "bias_2": (members, hidden),
        }
        arrays += [(name, getattr(branch, name), shape) for name, shape in shapes.items()]
        pooled += 2 * hidden + (0 if columns.frame else 2 * c)
    arrays += [
        ("fill", numbers.fill, (sum(each.width for each in numbers.columns),)),
        ("head_weight", numbers.head_weight, (members, n_classes, pooled)),
        ("head_bias", numbers.head_bias, (members, n_classes)),
        ("temperature", np.asarray(numbers.temperature), ()),
    ]
    for name, array, shape in arrays:
        if array.shape != shape or array.dtype.kind != "f" or not np.isfinite(array).all():
            raise DataError(f"the network's {name} are not {shape} finite numbers")
    if members == 0 or not numbers.temperature > 0 or any((b.std <= 0).any() for b in numbers.branches):
        raise DataError("the network has no members, or a scale that is not above zero")
