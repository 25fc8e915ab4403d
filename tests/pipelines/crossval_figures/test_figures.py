"""Figures show the numbers of the report; the same report gives the same bytes."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.container import BarContainer, ErrorbarContainer

from pipelines.crossval.results import ChannelImportance
from pipelines.crossval_figures.figures import (
    MAX_FEATURES,
    MAX_RUNS,
    all_figures,
    confusion_figure,
    importance_figure,
    learning_curve_figure,
    per_run_figure,
    reliability_figure,
)
from pipelines.reporting.drawing import png_bytes, svg_text
from pipelines.reporting.numbers import NOT_KNOWN
from terrain.classify.metrics import RunFigures


def run(run_id, terrain, accuracy, n_windows=10, mistaken_for=None):
    return RunFigures(run_id, terrain, n_windows, accuracy, accuracy, mistaken_for)


@pytest.fixture
def report(make_report):
    return make_report(
        confusion=((30, 10), (6, 114)),
        ece=0.0512,
        per_run=(
            run("g1", "GRASS", 0.25, 4, "ICE"),
            run("g2", "GRASS", 1.0, 6),
            run("i1", "ICE", 0.95, 30, "GRASS"),
        ),
    )


@pytest.fixture
def importances():
    return [ChannelImportance(f"feature_{i}", 0.001 * i, 0.0005) for i in range(-1, 24)]


def texts(axes):
    return [text.get_text() for text in axes.texts]


def overlap(figure, texts):
    """Return the pairs of texts that lie over each other."""
    figure.draw_without_rendering()
    boxes = [(text.get_text(), text.get_window_extent()) for text in texts if text.get_text()]
    return [(a, b) for i, (a, left) in enumerate(boxes) for b, right in boxes[:i] if left.overlaps(right)]


def test_a_confusion_cell_holds_percentage_and_windows_per_repeat(report):
    assert texts(confusion_figure(report).axes[0]) == ["75%\n(7.5)", "25%\n(2.5)", "5%\n(1.5)", "95%\n(28.5)"]


def test_confusion_has_true_rows_from_the_top_and_predicted_columns(report):
    axes = confusion_figure(report).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["GRASS", "ICE"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["GRASS\n10 windows", "ICE\n30 windows"]
    assert axes.get_ylim() == (2, 0)
    np.testing.assert_allclose(np.asarray(axes.collections[0].get_array()), [[0.75, 0.25], [0.05, 0.95]])


def test_a_class_that_was_never_tested_has_dashes_and_no_zero(report):
    untested = replace(report, confusion=((0, 0), (6, 114)))
    assert texts(confusion_figure(untested).axes[0])[:2] == [NOT_KNOWN, NOT_KNOWN]


def test_reliability_draws_every_bin_and_names_the_error(report):
    figure = reliability_figure(report)
    points = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    drawn = np.concatenate([line.get_xydata() for line in points])
    np.testing.assert_allclose(drawn, [[0.6, 0.7], [0.9, 0.85]])
    assert [len(line.get_xydata()) for line in points] == [1, 1], "one bin is under-, one over-confident"
    assert figure.get_suptitle().endswith("ECE 5.1%")
    strip = next(c for c in figure.axes[1].collections if isinstance(c, LineCollection))
    assert [segment[0, 0] for segment in strip.get_segments()] == [0.6, 0.9]


def test_bar_lengths_are_the_accuracies_of_the_runs(report):
    axes = per_run_figure(report).axes[0]
    bars = {bar.get_label(): [patch.get_width() for patch in bar] for bar in axes.containers}
    assert bars == {"GRASS": [0.25, 1.0], "ICE": [0.95]}
    assert [label.get_text() for label in axes.get_yticklabels()] == ["g1", "g2", "i1"]
    centres = [patch.get_y() + patch.get_height() / 2 for bar in axes.containers for patch in bar]
    np.testing.assert_allclose(centres, axes.get_yticks())
    colours = [{patch.get_facecolor() for patch in bar} for bar in axes.containers]
    assert len(colours[0]) == 1
    assert colours[0] != colours[1]


def test_the_class_mean_weighs_runs_by_their_windows(report):
    axes = per_run_figure(report).axes[0]
    means = [c.get_segments()[0][0, 0] for c in axes.collections if isinstance(c, LineCollection)]
    np.testing.assert_allclose(means, [0.7, 0.95])
    assert "GRASS: 70.0% of 10 windows, 2 runs" in texts(axes)
    assert "ICE: 95.0% of 30 windows, one run only" in texts(axes)


def test_a_long_name_of_the_data_does_not_push_the_title_out(report):
    named = report.named("a_data_set_with_a_name_that_does_not_end_so_soon", "")
    for figure in all_figures(named).values():
        figure.draw_without_rendering()
        assert figure._suptitle.get_window_extent().x1 <= figure.bbox.width


def test_only_a_run_below_one_half_shows_what_it_is_mistaken_for(report):
    assert [text for text in texts(per_run_figure(report).axes[0]) if "mistaken for" in text] == [
        "mistaken for ICE"
    ]


@pytest.mark.parametrize("n_runs", [18, 51])
def test_run_names_neither_overlap_nor_leave_the_figure(report, n_runs):
    runs = [
        run(f"{name}_long_name_{i:02d}", name, i / n_runs, 100 + i, "ICE")
        for name in report.classes
        for i in range(n_runs // 2 + 1)
    ]
    figure = per_run_figure(replace(report, per_run=runs))
    labels = figure.axes[0].get_yticklabels()
    assert overlap(figure, [*labels, *figure.axes[0].texts]) == []
    assert min(label.get_window_extent().x0 for label in labels) >= 0
    assert max(text.get_window_extent().x1 for text in figure.axes[0].texts) <= figure.bbox.width


def test_of_very_many_runs_the_worst_are_drawn_and_the_title_says_so(report):
    figure = per_run_figure(replace(report, per_run=[run(f"r{i}", "ICE", i / 300) for i in range(300)]))
    widths = [patch.get_width() for bar in figure.axes[0].containers for patch in bar]
    assert widths == [i / 300 for i in range(MAX_RUNS)]
    assert f"the worst {MAX_RUNS} of 300" in figure.get_suptitle()


def test_learning_curve_has_a_spread_where_there_is_one(report):
    figure = learning_curve_figure(report, report.extras.learning_curve)
    axes = figure.axes[0]
    np.testing.assert_allclose(axes.lines[0].get_xydata(), [[1.0, 0.5], [2.0, 0.6], [3.5, 0.65]])
    bars = next(c for c in axes.containers if isinstance(c, ErrorbarContainer))[2][0].get_segments()
    np.testing.assert_allclose([bar[:, 1] for bar in bars], [[0.48, 0.52], [0.59, 0.61]])
    assert figure.get_supxlabel() == "3 sizes are too few to estimate how many runs are enough."


@pytest.mark.parametrize(("enough", "drawn"), [(5, True), (50, False)])
def test_enough_runs_is_drawn_only_where_it_does_not_squeeze_the_curve(report, enough, drawn):
    curve = report.extras.learning_curve._replace(enough_runs=enough)
    axes = learning_curve_figure(report, curve).axes[0]
    assert (f"enough by the fitted law: {enough}" in [line.get_label() for line in axes.lines]) == drawn


def test_importance_is_sorted_cut_and_in_percentage_points(importances):
    figure = importance_figure(importances)
    axes = figure.axes[0]
    bars = next(c for c in axes.containers if isinstance(c, BarContainer))
    np.testing.assert_allclose([patch.get_width() for patch in bars], [0.1 * i for i in range(23, 3, -1)])
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == [f"feature_{i}" for i in range(23, 3, -1)]
    assert f"{MAX_FEATURES} of 25" in figure.get_suptitle()


def test_only_figures_whose_data_are_there_are_drawn(report, importances):
    assert list(all_figures(report, importances)) == [
        "confusion", "per_run", "reliability", "learning_curve", "importance",
    ]  # fmt: skip
    assert list(all_figures(replace(report, extras=None))) == ["confusion", "per_run", "reliability"]


def test_same_report_gives_same_bytes_and_another_gives_others(report):
    once, again = confusion_figure(report), confusion_figure(report)
    assert png_bytes(once) == png_bytes(again)
    assert svg_text(once) == svg_text(again) == svg_text(once), "and drawing changes nothing"
    assert "<dc:date>" not in svg_text(once)
    other = replace(report, confusion=((31, 9), (6, 114)))
    assert svg_text(confusion_figure(other)) != svg_text(once)


def test_a_name_is_drawn_as_it_is_written(report):
    runs = [each._replace(run_id=r"$\frac{1}$") for each in report.per_run]
    assert png_bytes(per_run_figure(replace(report, per_run=runs)))


@pytest.mark.slow
def test_no_global_state_is_touched():
    code = (
        "import sys, matplotlib\n"
        "settings = lambda: {k: v for k, v in matplotlib.rcParams.copy().items() if k != 'backend'}\n"
        "before = settings()\n"
        "from pipelines.reporting.drawing import svg_text\n"
        "from pipelines.crossval_figures.figures import importance_figure\n"
        "from pipelines.crossval.results import ChannelImportance\n"
        "svg_text(importance_figure([ChannelImportance('imu.gyro_x', 0.2, 0.01)]))\n"
        "assert settings() == before, 'settings changed'\n"
        "assert 'matplotlib.pyplot' not in sys.modules, 'pyplot imported'\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
