"""What is reported along a sequence: delays, flips and accuracies that were put in come out."""

import numpy as np
import pytest

from terrain.classify.sequence_figures import STRIDE_S, Track, last_class, sequence_figures, track_of
from terrain.records import Label

TRUE = np.repeat([0, 1, 0], 80)


def track(filtered, single, runs=("run 0", "run 1", "run 2")):
    """Return a track of three grounds of 20 s each."""
    ground, begin_s = np.repeat(np.arange(3), 80), 20.0 * np.arange(3)
    time_s = STRIDE_S * np.arange(1, 241)
    whole = time_s - begin_s[ground] >= 2.0
    return Track(time_s, ground, whole, filtered, single, np.array([0, 1, 0]), runs, begin_s, True)


def test_accuracy_delay_and_flips_are_those_that_were_put_in():
    late = np.concatenate((TRUE[:1].repeat(10), TRUE[:-10]))  # every change 2.5 s late
    noisy = TRUE.copy()
    noisy[[40, 120, 200]] = 2
    figures = sequence_figures([track(late, noisy)], 0)
    delay = figures.filter_delay_s
    assert (delay.p50, delay.p90, delay.n_changes, delay.n_missed) == (2.75, 2.75, 2, 0)
    assert figures.filtered_accuracy_at_end == pytest.approx(1 - 20 / 240)
    assert figures.single_accuracy_at_end == pytest.approx(1 - 3 / 240)
    assert figures.filtered_accuracy == pytest.approx(1 - 6 / 219)
    assert (figures.flips_per_minute, figures.duration_s) == (0.0, 60.0)
    assert figures.single_flips_per_minute == pytest.approx(6.0)


def test_a_change_that_is_never_found_is_counted_and_not_averaged():
    never = np.zeros(240, dtype=int)
    delay = sequence_figures([track(never, never)], 0).filter_delay_s
    assert (delay.n_changes, delay.n_missed, delay.p90_of_all) == (2, 1, None)
    assert delay.p90 == 0.25  # back on the ground that it never left
    figures = sequence_figures([track(never - 1, never - 1)], 0)
    assert (figures.unknown_ratio, figures.filtered_accuracy) == (1.0, 0.0)
    assert np.isnan(figures.filter_delay_s.p90)
    assert sequence_figures([], 0) is None


def test_the_interval_covers_the_accuracy_of_unlike_runs():
    rng = np.random.default_rng(2)
    tracks = []
    for i in range(12):
        found = np.where(rng.random(240) < rng.uniform(0.6, 1.0), TRUE, 2)
        tracks.append(track(found, TRUE, (f"a {i}", f"b {i}", f"c {i}")))
    figures = sequence_figures(tracks, 0)
    low, high = figures.filtered_accuracy_ci
    assert low < figures.filtered_accuracy < high
    assert 0.02 < high - low < 0.3
    assert figures.gain == pytest.approx(figures.filtered_accuracy - 1.0)
    assert sequence_figures(tracks, 0) == figures


def test_the_last_class_holds_through_refused_windows():
    rng = np.random.default_rng(3)
    probability = rng.dirichlet(np.ones(3), 50)
    probability[rng.random(50) < 0.4] = np.nan
    now, expected = -1, []
    for row in probability:
        now = now if np.isnan(row).any() else int(row.argmax())
        expected.append(now)
    assert last_class(probability).tolist() == expected


def test_a_sequence_is_followed_along_its_labels():
    labels = [Label(0.0, 10.0, "ice"), Label(10.0, 20.0, "mud")]
    starts_s = np.arange(0.0, 18.1, STRIDE_S)
    probability = np.where(starts_s[:, None] + 1.0 < 10.0, [0.95, 0.05], [0.05, 0.95])
    prior, classes = np.array([0.5, 0.5]), np.array(["ice", "mud"])
    found = track_of(labels, ("a", "b"), starts_s, 2.0, probability, classes, prior, False)
    assert found.time_s[found.ground == 1][0] == 10.25
    assert found.time_s[found.whole & (found.ground == 1)][0] == 12.0
    assert (found.terrain.tolist(), found.begin_s.tolist()) == ([0, 1], [0.0, 10.0])
    figures = sequence_figures([found], 0)
    assert (figures.single_accuracy, figures.filtered_accuracy, figures.n_grounds) == (1.0, 1.0, 2)
    assert 0.5 < figures.filter_delay_s.p50 < 3.0
