"""Figures of a diagnosis, and the stretch that is shown as an example."""

import numpy as np
import pytest

from pipelines.explain.figures import (
    MANY_RUNS,
    dependence_figure,
    parts_figure,
    run_figure,
    spectra_figure,
    strongest_figure,
    systematic_figure,
)
from pipelines.reporting.drawing import png_bytes
from terrain.discrepancy.compared import ComparedRun, example_stretch
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.parts import Part, PartValues
from terrain.discrepancy.verdict import Residual, Value
from terrain.effects import CHANNELS

RATE_HZ = 6.25
C = CHANNELS.index("speed_x_mps")


def a_noise(std=0.01):
    """White noise of that size at any speed, in two channels."""
    growth = np.full((len(CHANNELS), 3), np.nan)
    filters = np.full((len(CHANNELS), 7), np.nan)
    for c in (0, C):
        growth[c] = std**2, 0.0, 0.0
        filters[c] = 1.0, *np.zeros(6)
    return Noise(growth, filters, np.full(len(CHANNELS), std))


def a_run(name="r", off=0.0, seed=0, n=300, held_out=False, after=True):
    rng = np.random.default_rng(seed)
    measured = np.full((n, len(CHANNELS)), np.nan)
    measured[:, [0, C]] = 0.01 * rng.standard_normal((n, 2))
    measured[:, C] += off
    before = np.zeros_like(measured)
    fixed = before.copy()
    fixed[:, C] = off
    time_s = np.arange(n) / RATE_HZ
    inputs = {"speed_mps": np.sin(time_s), "roll_rad": np.zeros(n), "time_s": time_s}
    return ComparedRun(
        name, "grass", held_out, time_s, np.ones(n), measured, before, fixed if after else None, inputs
    )


def test_the_example_stretch_is_of_a_run_with_larger_residuals_than_most():
    runs = [a_run(f"r{i}", off=0.02 * i, seed=i) for i in (3, 0, 2, 4, 1)]
    found = example_stretch(runs, a_noise())
    assert found.run_id == "r3"
    assert 19.0 < found.time_s[-1] - found.time_s[0] <= 20.0
    short = example_stretch([a_run(n=50)], a_noise())
    assert len(short.time_s) == 50


@pytest.mark.slow
@pytest.mark.parametrize("after", [True, False])
def test_pictures_of_runs_are_the_same_bytes_again(after):
    runs = [a_run(f"run$_{i}^", off=0.05, seed=i, after=after) for i in range(3)]
    noise = a_noise()
    parts = [
        PartValues(
            Value("lever_x_m", 0.1, "m", 0.05, 0.15),
            (Part("first third", 0.1, 0.1), Part("rest", np.nan, np.nan)),
        )
    ]
    residual = {"speed_x_mps": Residual(0.05, np.nan, np.nan)}
    for figure in (
        lambda: run_figure(runs[0], noise, "a $title^"),
        lambda: spectra_figure(runs, noise, 2.5),
        lambda: dependence_figure(runs, noise),
        lambda: strongest_figure(runs),
        lambda: parts_figure(parts),
        lambda: systematic_figure(residual, residual, after),
    ):
        assert png_bytes(figure()) == png_bytes(figure())


def test_of_many_runs_the_axis_shows_how_their_means_are_distributed():
    few, many = ([a_run(f"r{i}", 0.02 * i, i, n=60) for i in range(n)] for n in (MANY_RUNS, MANY_RUNS + 1))
    labels = [dependence_figure(runs, a_noise()).axes[-1].get_xlabel() for runs in (few, many)]
    assert labels == ["run", "number of runs"]


def test_the_band_of_the_noise_stays_at_zero_where_a_residual_has_an_offset():
    figure = run_figure(a_run(off=0.5, after=False), a_noise(), "a run")
    right = figure.axes[2 * 1 + 1]
    band = right.collections[0].get_paths()[0].vertices[:, 1]
    line = max((line.get_ydata() for line in right.lines), key=len)
    assert -band.min() == pytest.approx(band.max())
    assert band.max() < 0.1 < np.median(line)
