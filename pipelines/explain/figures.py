"""Pictures of a diagnosis: measured against simulated, and where what is left between them comes from."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from scipy.signal import welch
from scipy.stats import t as student

from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GRID,
    INK,
    VERMILION,
    finished,
    new_figure,
    shorten,
    styled,
)
from pipelines.reporting.numbers import format_number as said
from terrain.discrepancy.noise import Noise
from terrain.effects import CHANNELS
from terrain.records import Array

CHANNEL_WORDS = {
    "yaw_rate_radps": ("yaw rate, gyro", "rad/s"),
    "speed_x_mps": ("speed ahead", "m/s"),
    "speed_y_mps": ("speed to the left", "m/s"),
    "accel_x_mps2": ("accelerometer ahead", "m/s²"),
    "current_a": ("sum of the currents", "A"),
    "turning_current_a": ("right minus left current", "A"),
    "heading_rate_radps": ("heading rate, no gyro", "rad/s"),
}
"""What a channel is called, and its unit."""

STRETCH_S = 20.0
"""Of the telling run that is drawn large."""

TELLING = 0.8
"""Share of the runs, and of the stretches of one, with less to explain than the one that is drawn."""

STRETCH_STEP_S = 1.0
BAND_STDS = 2.0
"""Half width of the noise band in standard deviations."""

N_BINS = 6
EDGE_SHARE = 0.01
"""Of an input's values that lie beyond the outer bins on either side: outliers would stretch all of them."""

MIN_SPREAD = 0.01
"""Range of an input in its own unit, below which nothing can be seen to follow it."""

MIN_IN_BIN = 3
"""Rows of a run in a bin, without which it has no mean there."""

SEGMENT_ROWS = 64
"""Of a spectrum: some 10 s."""

MIN_SEGMENT_ROWS = 8
"""Shortest segment of a spectrum, in rows."""

COVARIANCE_ROWS = 8192
"""Grid of the spectrum from which the covariance of coloured noise is taken."""

COLUMNS = 3
BEFORE, AFTER = "simulated", "with the causes built in"


class Shown(NamedTuple):
    """A run as it is drawn, behind the common low-pass.

    Parameters
    ----------
    run_id, terrain : of the run
    held_out : whether it was kept from the diagnosis
    time_s : (m,)
    pace_mps : (m,) of the wheels: what noise grows with
    measured, before : (m, channels)
    after : (m, channels) with the causes built in; None where none was named
    inputs : by name, with its unit: (m,) what drives the simulation
    """

    run_id: str
    terrain: str
    held_out: bool
    time_s: Array
    pace_mps: Array
    measured: Array
    before: Array
    after: Array | None
    inputs: Mapping[str, Array]

    def part(self, start_s: float, end_s: float) -> Shown:
        """Return the stretch from start to end."""
        keep = (self.time_s >= start_s) & (self.time_s <= end_s)
        return self._replace(
            time_s=self.time_s[keep],
            pace_mps=self.pace_mps[keep],
            measured=self.measured[keep],
            before=self.before[keep],
            after=None if self.after is None else self.after[keep],
            inputs={name: values[keep] for name, values in self.inputs.items()},
        )


def size_of(run: Shown, noise: Noise) -> float:
    """Return the mean squared residual of a run over that of noise, before; NaN where nothing is known."""
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = ((run.measured - run.before) / noise.size(run.pace_mps)) ** 2
    known = squared[np.isfinite(squared)]
    return float(known.mean()) if known.size else math.nan


def telling(runs: Sequence[Shown], noise: Noise, span_s: float = STRETCH_S) -> Shown:
    """Return the stretch of a run with larger residuals over the noise than most, and not the largest."""
    run = _telling(runs, lambda one: size_of(one, noise))
    starts = np.arange(run.time_s[0], max(run.time_s[-1] - span_s, run.time_s[0]) + 1e-9, STRETCH_STEP_S)
    return _telling([run.part(start, start + span_s) for start in starts], lambda one: size_of(one, noise))


def _telling(runs: Sequence[Shown], size: Callable[[Shown], float]) -> Shown:
    sizes = np.array([size(run) for run in runs])
    order = [i for i in np.argsort(sizes, kind="stable") if np.isfinite(sizes[i])]
    return runs[order[round(TELLING * (len(order) - 1))]] if order else runs[0]


def channels_of(runs: Sequence[Shown]) -> list[str]:
    """Return the channels that any run has."""
    seen = np.any([np.isfinite(run.measured).any(axis=0) for run in runs], axis=0)
    return [name for name, there in zip(CHANNELS, seen, strict=True) if there]


def run_figure(run: Shown, noise: Noise, title: str) -> Figure:
    """Draw each channel measured and simulated on the left, and what is between them on the right."""
    names = channels_of([run])
    bands = BAND_STDS * noise.size(run.pace_mps)
    with styled():
        figure = new_figure(10.0, 1.1 + 1.25 * len(names))
        figure.set_layout_engine(
            "none"
        )  # there may be hundreds of them, and a layout takes as long as a picture
        height = figure.get_figheight()
        room = {"left": 0.065, "right": 0.99, "bottom": 0.8 / height, "top": 1.0 - 0.55 / height}
        panels = figure.subplots(
            len(names), 2, sharex=True, squeeze=False, gridspec_kw=room | {"wspace": 0.17, "hspace": 0.42}
        )
        figure.suptitle(
            title, x=0.015, y=1.0 - 0.1 / height, ha="left", va="top", fontsize=10.5, weight="bold"
        )
        for (left, right), name in zip(panels, names, strict=True):
            c = CHANNELS.index(name)
            words, unit = CHANNEL_WORDS[name]
            _line(left, run.time_s, run.measured[:, c], INK, "measured", 1.4)
            _line(left, run.time_s, run.before[:, c], VERMILION, BEFORE, 1.0)
            right.fill_between(
                run.time_s, -bands[:, c], bands[:, c], color=GRID, lw=0, label="noise, 95 % at that speed"
            )
            _line(right, run.time_s, (run.measured - run.before)[:, c], VERMILION, "", 1.0)
            if run.after is not None:
                _line(left, run.time_s, run.after[:, c], BLUE, AFTER, 1.0)
                _line(right, run.time_s, (run.measured - run.after)[:, c], BLUE, "", 1.0)
            left.set_title(f"{words} [{unit}]", loc="left", fontsize=8.5)
            right.set_title("measured minus simulated", loc="left", fontsize=8.5, color=FAINT_INK)
            for axes in (left, right):
                axes.yaxis.set_major_locator(MaxNLocator(4))
                axes.grid(axis="y")
        for axes in panels[-1]:
            axes.set_xlabel("time in the run [s]")
        _legend(figure, panels.ravel(), "lower center")
        return figure


def share_figure(before: Mapping[str, Any], after: Mapping[str, Any], extended: bool) -> Figure:
    """Draw, a channel a bar, how much of the squared residual is not noise.

    Parameters
    ----------
    before, after : by channel, with ``rms``, ``noise`` and ``systematic``
    extended : whether any cause was built in
    """
    names = list(before)
    kinds = [(BEFORE, VERMILION, before), *([(AFTER, BLUE, after)] if extended else [])]
    with styled():
        figure = new_figure(10.0, 1.0 + (0.32 + 0.2 * len(kinds)) * len(names))
        axes = figure.subplots()
        height = 0.76 / len(kinds)
        for place, (kind, colour, residuals) in enumerate(kinds):
            for row, name in enumerate(names):
                unit = CHANNEL_WORDS[name][1]
                share, rms, noise = (residuals[name][key] for key in ("systematic", "rms", "noise"))
                at = row + (place - (len(kinds) - 1) / 2) * height
                axes.barh(at, 1.0, height=0.92 * height, color=GRID)
                axes.barh(at, share or 0.0, height=0.92 * height, color=colour, label=kind if not row else "")
                told = "" if share is None else f"{100 * share:.0f} %"
                numbers = [
                    f"{word} {said(n)}" for word, n in (("rms", rms), ("noise", noise)) if n is not None
                ]
                axes.text(
                    1.01, at, f"{told}   {', '.join(numbers)} {unit}".strip(), va="center", fontsize=7.5
                )
        axes.set_xlim(0.0, 1.36)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "25 %", "50 %", "75 %", "100 %"])
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_yticks(range(len(names)), [CHANNEL_WORDS[name][0] for name in names])
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.spines["bottom"].set_bounds(0.0, 1.0)
        _legend(figure, [axes])
        return finished(figure, "Share of the squared residual that is systematic; grey: noise")


def spectra_figure(runs: Sequence[Shown], noise: Noise, cutoff_hz: float) -> Figure:
    """Draw the spectrum of each channel's residual before and after, and that of the noise."""
    names = channels_of(runs)
    rate_hz = 1.0 / float(np.median(np.diff(runs[0].time_s)))
    n_rows = math.ceil(len(names) / COLUMNS)
    with styled():
        figure = new_figure(10.0, 0.9 + 2.1 * n_rows)
        grid = figure.subplots(n_rows, COLUMNS, squeeze=False)
        for number, axes in enumerate(grid.ravel()):
            if number >= len(names):
                axes.set_axis_off()
                continue
            c = CHANNELS.index(names[number])
            words, unit = CHANNEL_WORDS[names[number]]
            power = float(np.concatenate([noise.size(run.pace_mps)[:, c] ** 2 for run in runs]).mean())
            for after, colour, kind in ((False, VERMILION, BEFORE), (True, BLUE, AFTER)):
                if after and runs[0].after is None:
                    continue
                frequency, density = spectrum([_residual(run, after)[:, c] for run in runs], rate_hz)
                axes.plot(frequency, density, color=colour, lw=1.3, label=kind)
            frequency = np.linspace(frequency[0], rate_hz / 2, 200)
            density = power * noise_spectrum(noise.filters[c], frequency, rate_hz)
            axes.plot(frequency, density, color=INK, lw=1.0, ls="--", label="noise")
            axes.set_xscale("log")
            axes.set_yscale("log")
            axes.axvline(cutoff_hz, color=FAINT_INK, lw=0.7, ls=":")
            axes.set_title(f"{words} [{f'({unit})' if '/' in unit else unit}²/Hz]", loc="left", fontsize=8.5)
            ticks = [f for f in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0) if frequency[0] <= f <= rate_hz / 2]
            axes.set_xticks(ticks, [f"{f:g}" for f in ticks])
            axes.xaxis.set_minor_locator(NullLocator())
            axes.yaxis.set_major_locator(LogLocator(numticks=5))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda power, _: said(power)))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.grid(axis="y")
            if number + COLUMNS >= len(names):
                axes.set_xlabel("frequency [Hz]")
        _legend(figure, grid.ravel()[: len(names)])
        return finished(figure, "Spectrum of measured minus simulated, mean over runs")


def spectrum(residuals: Sequence[Array], rate_hz: float) -> tuple[Array, Array]:
    """Return frequencies and one-sided density of residuals of several runs, of stretches without a hole.

    Segments are as short as it takes for half of what is known to lie in stretches of that length; where not
    even :data:`MIN_SEGMENT_ROWS` will do, the density is NaN.
    """
    parts = [part for values in residuals for part in _whole(values)]
    n_known = sum(map(len, parts))
    n_rows = SEGMENT_ROWS
    while n_rows > MIN_SEGMENT_ROWS and 2 * sum(len(part) for part in parts if len(part) >= n_rows) < n_known:
        n_rows //= 2
    long = [part for part in parts if len(part) >= n_rows]
    total = np.zeros(n_rows // 2 + 1) if long else np.full(n_rows // 2 + 1, np.nan)
    for part in long:
        total += len(part) * welch(part, rate_hz, nperseg=n_rows, detrend=False)[1]
    frequency = np.fft.rfftfreq(n_rows, 1.0 / rate_hz)
    return frequency[1:], total[1:] / max(sum(map(len, long)), 1)


def noise_spectrum(weights: Array, frequency_hz: Array, rate_hz: float) -> Array:
    """Return the one-sided density of the noise that a whitening filter (order + 1,) turns white."""
    turn = np.exp(-2j * np.pi * np.outer(frequency_hz / rate_hz, np.arange(len(weights))))
    density: Array = 2.0 / rate_hz / np.abs(turn @ weights) ** 2
    return density


def _whole(values: Array) -> Iterator[Array]:
    """Give the stretches of a signal without a hole."""
    known = np.isfinite(values)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield values[start:end]


def dependence_figure(runs: Sequence[Shown], noise: Noise) -> Figure:
    """Draw the mean residual of each channel over each input, time and run."""
    names = channels_of(runs)
    inputs = [name for name in runs[0].inputs if _spread(runs, name) > MIN_SPREAD]
    with styled():
        figure = new_figure(10.0, 1.15 + 1.2 * len(names))
        grid = figure.subplots(len(names), len(inputs) + 1, sharey="row", sharex="col", squeeze=False)
        for row, name in enumerate(names):
            c = CHANNELS.index(name)
            words, unit = CHANNEL_WORDS[name]
            for after, colour, kind in ((False, VERMILION, BEFORE), (True, BLUE, AFTER)):
                if after and runs[0].after is None:
                    continue
                residuals = [_residual(run, after)[:, c] for run in runs]
                for axes, key in zip(grid[row], inputs, strict=False):
                    _points(axes, *binned([run.inputs[key] for run in runs], residuals), colour, kind)
                sizes = [noise.size(run.pace_mps)[:, c] for run in runs]
                means = run_means(residuals, sizes, noise.filters[c])
                _points(grid[row, -1], np.arange(1.0, len(runs) + 1), *means, colour, kind, joined=False)
            for axes in grid[row]:
                axes.axhline(0.0, color=FAINT_INK, lw=0.7)
                axes.yaxis.set_major_locator(MaxNLocator(3))
                axes.xaxis.set_major_locator(MaxNLocator(3))
                axes.tick_params(labelsize=7)
                axes.grid(axis="y")
            grid[row, 0].set_title(f"{words} [{unit}]", loc="left", fontsize=8.5)
        for axes, key in zip(grid[-1], [*inputs, "run"], strict=True):
            axes.set_xlabel(key, fontsize=8)
        grid[-1, -1].set_xlim(0.3, len(runs) + 0.7)
        grid[-1, -1].xaxis.set_major_locator(MaxNLocator(3, integer=True))
        _legend(figure, grid.ravel())
        return finished(figure, "What the residual follows: its mean and the 95 % interval of it, by bins")


def _spread(runs: Sequence[Shown], key: str) -> float:
    values = np.concatenate([run.inputs[key] for run in runs])
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0
    low, high = _range(known)
    return high - low


def _range(known: Array) -> tuple[float, float]:
    """Return the range of values without outliers."""
    low, high = np.quantile(known, [EDGE_SHARE, 1.0 - EDGE_SHARE])
    return float(low), float(high)


def binned(inputs: Sequence[Array], residuals: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return centres, means and half 95 % intervals over runs of residuals in bins of equal width.

    Examples
    --------
    >>> x = np.linspace(-0.06, 6.06, 613)
    >>> centres, means, _ = binned([x, x], [2 * x, 2 * x + 2])
    >>> centres.round(1), means.round(0)
    (array([0.5, 1.5, 2.5, 3.5, 4.5, 5.5]), array([ 2.,  4.,  6.,  8., 10., 12.]))
    """
    known = np.concatenate([x[np.isfinite(x)] for x in inputs])
    nothing = np.empty(0)
    if not known.size:
        return nothing, nothing, nothing
    edges = np.linspace(*_range(known), N_BINS + 1)
    found = []
    for low, high in itertools.pairwise(edges):
        each = []
        for given, left in zip(inputs, residuals, strict=True):
            inside = (given >= low) & (given < high) & np.isfinite(left)
            if inside.sum() >= MIN_IN_BIN:
                each.append(float(left[inside].mean()))
        n = len(each)
        if n:
            half = student.ppf(0.975, n - 1) * np.std(each, ddof=1) / math.sqrt(n) if n > 2 else math.nan
            found.append(((low + high) / 2, float(np.mean(each)), half))
    return tuple(np.array(found).T) if found else (nothing, nothing, nothing)


def run_means(residuals: Sequence[Array], sizes: Sequence[Array], weights: Array) -> tuple[Array, Array]:
    """Return the mean of each run and half its 95 % interval, were all but the mean coloured noise.

    Parameters
    ----------
    residuals : (m,) of each run
    sizes : (m,) of the noise
    weights : of the filter that whitens it
    """
    covariance = np.fft.irfft(1.0 / np.abs(np.fft.rfft(weights, COVARIANCE_ROWS)) ** 2)
    means, halves = [], []
    for left, size in zip(residuals, sizes, strict=True):
        known = np.isfinite(left)
        n = int(known.sum())
        if not n:
            means.append(math.nan)
            halves.append(math.nan)
            continue
        lags = np.arange(1, min(n, COVARIANCE_ROWS // 2))
        spread = (covariance[0] + 2.0 * float(((1.0 - lags / n) * covariance[lags]).sum())) / n
        means.append(float(left[known].mean()))
        halves.append(1.96 * math.sqrt(float((size[known] ** 2).mean()) * max(spread, 0.0)))
    return np.array(means), np.array(halves)


def _points(
    axes: Axes, x: Array, y: Array, half: Array, colour: str, label: str, joined: bool = True
) -> None:
    """Draw means with their intervals."""
    at, half = np.asarray(x), np.nan_to_num(half)
    axes.errorbar(
        at, y, half, color=colour, lw=1.1 if joined else 0.0, elinewidth=1.0, marker="o", ms=2.6, label=label
    )


def _residual(run: Shown, after: bool) -> Array:
    simulated = run.after if after else run.before
    assert simulated is not None
    return run.measured - simulated


def _line(axes: Axes, time_s: Array, values: Array, colour: str, label: str, width: float) -> None:
    axes.plot(time_s, values, color=colour, lw=width, label=label or None, solid_joinstyle="round")


def _legend(figure: Figure, panels: Iterable[Axes], place: str = "outside lower center") -> None:
    """Draw one legend of all panels below them."""
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    figure.legend(list(found.values()), list(found), fontsize=8, frameon=False, ncols=4, loc=place)


def titled(run: Shown, whole: bool) -> str:
    """Return the title of a run's picture."""
    name = shorten(run.run_id, 40) + (f", {shorten(run.terrain, 24)}" if run.terrain else "")
    if whole:
        return name + (", held out" if run.held_out else "")
    return f"{name}: {run.time_s[0]:.0f} to {run.time_s[-1]:.0f} s"
