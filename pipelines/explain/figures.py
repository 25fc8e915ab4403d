"""Figures of a diagnosis: measured beside simulated, and what the residuals between them depend on."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from pipelines.report.figure import Band, Figure, Line, Mark, Panel, Points
from terrain.deviation import Deviation
from terrain.discrepancy.compared import (
    CHANNEL_WORDS,
    INPUT_LABELS,
    ComparedRun,
    binned_means,
    noise_spectrum,
    run_means,
    spectrum,
    strongest_input,
    varying_inputs,
)
from terrain.discrepancy.constancy import PartValues
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.robot_terms import quantity
from terrain.discrepancy.runs import measured_channels
from terrain.effects import CHANNELS
from terrain.records import Array

BAND = "95 % of a further run"
MEASURED, BEFORE, AFTER = "measured", "simulated", "extended"
BLUE, VERMILION, GREY = 0, 1, 6
AXIS = "{} [{}]"  #: Of what a channel is called, and its unit
LEAST_POWER = 1e-300  #: Under the logarithm of a spectrum


def run_figure(run: ComparedRun, deviation: Deviation, channels: Sequence[str]) -> Figure:
    """Return channels of a run as measured and simulated, a panel each, the band of the last simulation about it."""
    panels, colour = [], VERMILION if run.after is None else BLUE
    for name in channels:
        c, last, marks = CHANNELS.index(name), run.simulated[:, CHANNELS.index(name)], []
        if name in deviation.channels:
            half = deviation.channels[name].half_95(run.speed_mps, run.inputs["turn_mps"])
            marks.append(Band(BAND, run.time_s, last - half, last + half, colour))
        marks.append(Line(MEASURED, run.time_s, run.measured[:, c], GREY))
        marks.append(Line(BEFORE, run.time_s, run.before[:, c], VERMILION))
        if run.after is not None:
            marks.append(Line(AFTER, run.time_s, last, BLUE))
        panels.append(Panel(marks, AXIS.format(*CHANNEL_WORDS[name])))
    held_out = ", held out of the diagnosis" if run.held_out else ""
    title = f"{run.run_id}{f', {run.terrain}' if run.terrain else ''}{held_out}"
    caption = (
        f"The prediction of the simulation from the logged wheels, steering and tilt, beside the measurement; "
        f"the band about {BEFORE if run.after is None else AFTER} is that of 95 % of a further run, by the runs behind "
        "the fit, each left out of it in turn. All have passed the same low-pass."
    )
    return Figure(title, panels, caption, x_label="time in the run [s]")


def dependence_figures(runs: Sequence[ComparedRun], noise: Noise) -> tuple[Figure, list[Figure]]:
    """Return the mean residual of each channel over the input on which it depends most, and figures of every one."""
    strongest, every = [], []
    for name in measured_channels(runs):
        c, axis = CHANNELS.index(name), AXIS.format(*CHANNEL_WORDS[name])
        residuals, most = [*_residuals(runs, c)], strongest_input(runs, name)
        panels = {}
        for key in varying_inputs(runs):
            given = [run.inputs[key] for run in runs]
            marks = [_points(kind, colour, *binned_means(given, left)) for kind, colour, left in residuals]
            panels[key] = Panel(marks, axis, x_label=INPUT_LABELS[key])
        strongest.append(panels[most])
        at, sizes = np.arange(1.0, len(runs) + 1), [noise.size(run.pace_mps)[:, c] for run in runs]
        marks = []
        for kind, colour, left in residuals:
            marks.append(_points(kind, colour, at, *run_means(left, sizes, noise.filters[c])))
        caption = (
            "Measured minus simulated. Intervals are over runs; those of single runs come from the noise, and do "
            "not include differences from run to run. Turn: wheel speed right minus left, or last minus first "
            "wheel."
        )
        panels["run"] = Panel(marks, axis, x_label="run")
        every.append(Figure(CHANNEL_WORDS[name][0], list(panels.values()), caption))
    caption = (
        "Measured minus simulated: means over bins of the input on which the residual depends most, with 95 % "
        "intervals over runs. A residual that is noise depends on nothing: its means lie on zero."
    )
    return Figure("What each channel depends on most", strongest, caption), every


def parts_figure(parts: Sequence[PartValues]) -> Figure:
    """Return the value of each cause in thirds of the time and in halves of the runs."""
    panels = []
    for each in parts:
        at, ends = np.arange(1.0, len(each.names) + 1), np.array([0.5, len(each.names) + 0.5])
        low, high = np.full(2, each.value.low), np.full(2, each.value.high)
        title = f"{each.value.name}: {quantity(each.value.name, each.value.value)}"
        band = Band("all runs, 95 %", ends, low, high, GREY)
        panels.append(
            Panel([band, _points("a part", BLUE, at, each.values, each.halves)], each.value.unit, title)
        )
    names = "; ".join([f"{i}: {name}" for i, name in enumerate(parts[0].names, start=1)])
    caption = (
        "The value of each cause fitted to a part of the data: thirds of each run's time, and halves of the "
        f"runs. Bars and band: 95 % intervals. {names}."
    )
    return Figure("Whether the values are one number", panels, caption, x_label="part of the data")


def spectra_figure(runs: Sequence[ComparedRun], noise: Noise, cutoff_hz: float) -> Figure:
    """Return the spectrum of each channel's residual before and after, and that of the noise, in decibels."""
    rate_hz = 1.0 / float(np.median(np.diff(runs[0].time_s)))
    panels = []
    for name in measured_channels(runs):
        c, unit, curves = CHANNELS.index(name), CHANNEL_WORDS[name][1], []
        for kind, colour, left in _residuals(runs, c):
            curves.append((kind, *spectrum(left, rate_hz), colour))
        power = float(np.concatenate([noise.size(run.pace_mps)[:, c] ** 2 for run in runs]).mean())
        frequency_hz = np.geomspace(curves[0][1][0], rate_hz / 2, 100)
        shape = noise_spectrum(noise.filters[c], frequency_hz, rate_hz)
        curves.append(("noise", frequency_hz, power * shape, GREY))
        marks = [
            Line(kind, at_hz, 10.0 * np.log10(np.maximum(density, LEAST_POWER)), colour, kind == "noise")
            for kind, at_hz, density, colour in curves
        ]
        panels.append(Panel(marks, f"dB of ({unit})²/Hz", CHANNEL_WORDS[name][0], log_x=True))
    caption = (
        "Spectrum of measured minus simulated, mean over runs. A line above that of the noise is more than "
        f"noise. Beyond the cut-off of the low-pass, {cutoff_hz:.2g} Hz, nothing is compared."
    )
    return Figure("At which frequencies", panels, caption, x_label="frequency [Hz]")


def _residuals(runs: Sequence[ComparedRun], c: int) -> Iterator[tuple[str, int, list[Array]]]:
    """Yield the residuals of a channel before and, where anything was built in, after: label, colour, by run."""
    for label, colour, extended in ((BEFORE, VERMILION, False), (AFTER, BLUE, True)):
        if not extended or runs[0].after is not None:
            yield label, colour, [run.residual(extended)[:, c] for run in runs]


def _points(label: str, colour: int, at: Array, values: Array, halves: Array) -> Mark:
    """Return values with their intervals; one that is not known has none."""
    halves = np.nan_to_num(halves)
    return Points(label, at, values, values - halves, values + halves, colour)
