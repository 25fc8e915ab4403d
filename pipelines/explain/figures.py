"""Figures of a diagnosis: measured against simulated, and the causes of the residuals between them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from pipelines.reporting.drawing import (
    BLUE,
    FAINT_INK,
    GRID,
    INK,
    VERMILION,
    finished,
    new_figure,
    styled,
)
from pipelines.reporting.numbers import format_number
from pipelines.reporting.quantities import quantity
from terrain.discrepancy.channel_words import CHANNEL_WORDS, INPUT_LABELS
from terrain.discrepancy.compared import MIN_SPREAD, ComparedRun, channels_of, spread_of, strongest_input
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.parts import PartValues
from terrain.discrepancy.residual_statistics import (
    binned_means,
    noise_spectrum,
    run_means,
    spectrum,
)
from terrain.discrepancy.verdict import Residual
from terrain.effects import CHANNELS
from terrain.records import Array

BAND_STDS = 2.0
"""Half width of the noise band in standard deviations.  The band is about 0: an offset lies outside of it."""

COLUMNS = 3

MANY_RUNS = 24
"""Runs up to which each has a place on an axis; of more the distribution of their means is drawn."""

BEFORE, AFTER = "simulated", "with the causes built in"


def run_figure(run: ComparedRun, noise: Noise, title: str) -> Figure:
    """Draw each channel measured and simulated on the left, and what is between them on the right."""
    names = channels_of([run])
    bands = BAND_STDS * noise.size(run.pace_mps)
    with styled():
        figure = new_figure(10.0, 1.1 + 1.25 * len(names))
        figure.set_layout_engine(
            "none"
        )  # there may be hundreds of them, and a layout takes as long as a figure
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


def systematic_figure(
    before: Mapping[str, Residual], after: Mapping[str, Residual], extended: bool
) -> Figure:
    """Draw, a channel a bar, which part of the squared residual is systematic, not noise.

    Parameters
    ----------
    before, after : by channel
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
                residual = residuals[name]
                known = math.isfinite(residual.systematic)
                at = row + (place - (len(kinds) - 1) / 2) * height
                axes.barh(at, 1.0, height=0.92 * height, color=GRID)
                length = residual.systematic if known else 0.0
                axes.barh(at, length, height=0.92 * height, color=colour, label=kind if not row else "")
                percent = f"{100 * residual.systematic:.0f} %" if known else ""
                numbers = [
                    f"{word} {format_number(n)}"
                    for word, n in (("rms", residual.rms), ("noise", residual.noise))
                    if math.isfinite(n)
                ]
                text = f"{percent}   {', '.join(numbers)} {unit}".strip()
                axes.text(1.01, at, text, va="center", fontsize=7.5)
        axes.set_xlim(0.0, 1.36)
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "25 %", "50 %", "75 %", "100 %"])
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_yticks(range(len(names)), [CHANNEL_WORDS[name][0] for name in names])
        axes.tick_params(axis="y", length=0)
        axes.spines["left"].set_visible(False)
        axes.spines["bottom"].set_bounds(0.0, 1.0)
        _legend(figure, [axes])
        return finished(figure, "Systematic part of the squared residual; grey: noise")


def spectra_figure(runs: Sequence[ComparedRun], noise: Noise, cutoff_hz: float) -> Figure:
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
                frequency, density = spectrum([run.residual(after)[:, c] for run in runs], rate_hz)
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
            axes.yaxis.set_major_formatter(FuncFormatter(lambda power, _: format_number(power)))
            axes.yaxis.set_minor_locator(NullLocator())
            axes.grid(axis="y")
            if number + COLUMNS >= len(names):
                axes.set_xlabel("frequency [Hz]")
        _legend(figure, grid.ravel()[: len(names)])
        return finished(figure, "Spectrum of measured minus simulated, mean over runs")


def strongest_figure(runs: Sequence[ComparedRun]) -> Figure:
    """Draw the mean residual of each channel, before and after, over the input on which it depends most."""
    names = channels_of(runs)
    n_rows = math.ceil(len(names) / COLUMNS)
    with styled():
        figure = new_figure(10.0, 0.9 + 2.2 * n_rows)
        grid = figure.subplots(n_rows, COLUMNS, squeeze=False)
        for axes, name in itertools.zip_longest(grid.ravel(), names):
            if name is None:
                axes.set_axis_off()
                continue
            words, unit = CHANNEL_WORDS[name]
            key = strongest_input(runs, name)
            _means(axes, runs, name, key)
            axes.axhline(0.0, color=FAINT_INK, lw=0.7)
            axes.set_title(f"{words} [{unit}]", loc="left", fontsize=8.5)
            axes.set_xlabel(INPUT_LABELS[key])
            axes.grid(axis="y")
        _legend(figure, grid.ravel()[: len(names)])
        return finished(figure, "Measured minus simulated, over the input on which it depends most")


def parts_figure(parts: Sequence[PartValues]) -> Figure:
    """Draw the value of each cause in thirds of the time and in halves of the runs."""
    columns = min(COLUMNS, len(parts))
    n_rows = math.ceil(len(parts) / columns)
    with styled():
        figure = new_figure(10.0, 0.8 + 1.6 * n_rows)
        grid = figure.subplots(n_rows, columns, squeeze=False)
        for axes, each in itertools.zip_longest(grid.ravel(), parts):
            if each is None:
                axes.set_axis_off()
                continue
            at = np.arange(len(each.parts))[::-1]
            axes.axvspan(each.value.low, each.value.high, color=GRID, lw=0, label="all runs, 95 %")
            values, half = (
                np.array([getattr(part, key) for part in each.parts]) for key in ("value", "half")
            )
            axes.errorbar(values, at, xerr=np.nan_to_num(half), fmt="o", color=BLUE, ms=3.5, elinewidth=1.2)
            axes.set_yticks(at, [part.name for part in each.parts])
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.set_ylim(-0.6, len(at) - 0.4)
            axes.set_title(
                f"{each.value.name}: {quantity(each.value.name, each.value.value)}", loc="left", fontsize=8.5
            )
        _legend(figure, grid.ravel()[: len(parts)])
        return finished(figure, "Values of the causes by thirds of the time and halves of the runs")


def dependence_figure(runs: Sequence[ComparedRun], noise: Noise) -> Figure:
    """Draw the mean residual of each channel over each input, time and run."""
    names = channels_of(runs)
    inputs = [name for name in runs[0].inputs if spread_of(runs, name) > MIN_SPREAD]
    with styled():
        figure = new_figure(10.0, 1.15 + 1.2 * len(names))
        grid = figure.subplots(len(names), len(inputs) + 1, sharey="row", sharex="col", squeeze=False)
        for row, name in enumerate(names):
            words, unit = CHANNEL_WORDS[name]
            for axes, key in zip(grid[row], inputs, strict=False):
                _means(axes, runs, name, key)
            _run_axis(grid[row, -1], runs, noise, name)
            for axes in grid[row]:
                axes.axhline(0.0, color=FAINT_INK, lw=0.7)
                axes.yaxis.set_major_locator(MaxNLocator(3))
                axes.xaxis.set_major_locator(MaxNLocator(3))
                axes.tick_params(labelsize=7)
                axes.grid(axis="y")
            grid[row, 0].set_title(f"{words} [{unit}]", loc="left", fontsize=8.5)
        last = "run" if len(runs) <= MANY_RUNS else "number of runs"
        for axes, key in zip(grid[-1], [*(INPUT_LABELS[name] for name in inputs), last], strict=True):
            axes.set_xlabel(key, fontsize=8)
        grid[-1, -1].xaxis.set_major_locator(MaxNLocator(3, integer=True))
        _legend(figure, grid.ravel())
        return finished(figure, "What the residual depends on: its mean and the 95 % interval of it, by bins")


def _kinds(runs: Sequence[ComparedRun]) -> list[tuple[bool, str, str]]:
    """Return before and, where anything was built in, after: with its colour and label."""
    return [(False, VERMILION, BEFORE), *([(True, BLUE, AFTER)] if runs[0].after is not None else [])]


def _means(axes: Axes, runs: Sequence[ComparedRun], channel: str, key: str) -> None:
    c = CHANNELS.index(channel)
    for after, colour, kind in _kinds(runs):
        residuals = [run.residual(after)[:, c] for run in runs]
        _points(axes, *binned_means([run.inputs[key] for run in runs], residuals), colour, kind)


def _run_axis(axes: Axes, runs: Sequence[ComparedRun], noise: Noise, channel: str) -> None:
    """Draw the mean of each run, or of many runs how their means are distributed."""
    c = CHANNELS.index(channel)
    for after, colour, kind in _kinds(runs):
        residuals = [run.residual(after)[:, c] for run in runs]
        sizes = [noise.size(run.pace_mps)[:, c] for run in runs]
        means, halves = run_means(residuals, sizes, noise.filters[c])
        if len(runs) <= MANY_RUNS:
            _points(axes, np.arange(1.0, len(runs) + 1), means, halves, colour, kind, joined=False)
            continue
        known = means[np.isfinite(means)]
        axes.hist(known, bins=20, orientation="horizontal", histtype="step", color=colour, lw=1.1, label=kind)


def _points(
    axes: Axes, x: Array, y: Array, half: Array, colour: str, label: str, joined: bool = True
) -> None:
    """Draw means with their intervals."""
    at, half = np.asarray(x), np.nan_to_num(half)
    axes.errorbar(
        at, y, half, color=colour, lw=1.1 if joined else 0.0, elinewidth=1.0, marker="o", ms=2.6, label=label
    )


def _line(axes: Axes, time_s: Array, values: Array, colour: str, label: str, width: float) -> None:
    axes.plot(time_s, values, color=colour, lw=width, label=label or None, solid_joinstyle="round")


def _legend(figure: Figure, panels: Iterable[Axes], place: str = "outside lower center") -> None:
    """Draw one legend of all panels below them."""
    found: dict[str, Any] = {}
    for axes in panels:
        for handle, name in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(name, handle)
    figure.legend(list(found.values()), list(found), fontsize=8, frameon=False, ncols=4, loc=place)
