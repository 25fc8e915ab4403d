from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from pipelines.learn.crossval import EvaluationSettings, crossval
from pipelines.learn.evaluate import HeldOut
from pipelines.learn.sequences import breakaways_of
from pipelines.report.json_file import as_json
from terrain.classify.sequence_figures import STRIDE_S, Track, last_class, sequence_figures
from terrain.logs.splicing import Part, order_stretches, stretches_of
from terrain.records import Windows


def test_stretches_of_a_run_are_cut_without_remainder_or_overlap():
    rng = np.random.default_rng(0)
    for _ in range(200):
        part = Part(None, 3.0, 3.0 + rng.uniform(5.0, 120.0), "grass")
        found = stretches_of(part, rng)
        lengths_s = [each.end_s - each.start_s for each in found]
        if part.end_s - part.start_s < 10.0:
            assert found == []
            continue
        assert min(lengths_s) >= 10.0 - 1e-9
        assert max(lengths_s) <= 30.0 + 1e-9
        assert found[0].start_s == 3.0
        assert found[-1].end_s == pytest.approx(part.end_s)
        assert all(a.end_s == b.start_s for a, b in pairwise(found))


def test_grounds_of_a_course_alternate_and_as_few_as_possible_are_left_out():
    rng = np.random.default_rng(1)
    for _ in range(200):
        terrains = rng.choice(["ice", "snow", "grass"], rng.integers(2, 20), p=[0.5, 0.3, 0.2])
        found = order_stretches([Part(None, 0.0, 1.0, str(name)) for name in terrains], rng)
        names = [each.terrain for each in found]
        assert all(a != b for a, b in pairwise(names))
        most = max(Counter(terrains.tolist()).values())
        assert len(names) >= min(len(terrains), 2 * (len(terrains) - most) + 1)


def track_of(filtered, single, terrain=(0, 1, 0), n_each=80):
    """Return a track of grounds of 20 s each, and what was reported on each as (late by, then right)."""
    n = n_each * len(terrain)
    ground = np.repeat(np.arange(len(terrain)), n_each)
    time_s = STRIDE_S * np.arange(1, n + 1)
    begin_s = STRIDE_S * n_each * np.arange(len(terrain), dtype=float)
    return Track(
        time_s,
        ground,
        time_s - begin_s[ground] >= 2.0,
        np.asarray(filtered),
        np.asarray(single),
        np.array(terrain),
        tuple(f"run {i}" for i in range(len(terrain))),
        begin_s,
        True,
    )


def test_accuracy_delay_and_flips_are_those_that_were_put_in():
    true = np.repeat([0, 1, 0], 80)
    late = np.concatenate((true[:1].repeat(10), true[:-10]))  # every change 2.5 s late
    noisy = true.copy()
    noisy[[40, 120, 200]] = 2
    figures = sequence_figures([track_of(late, noisy)], 0)
    delay = figures.filter_delay_s
    assert (delay.p50, delay.p90, delay.n_changes, delay.n_missed) == (2.75, 2.75, 2, 0)
    assert figures.filtered_accuracy_at_end == pytest.approx(1 - 20 / 240)
    assert figures.single_accuracy_at_end == pytest.approx(1 - 3 / 240)
    assert figures.filtered_accuracy == pytest.approx(1 - 6 / 219)
    assert figures.flips_per_minute == 0.0
    assert figures.single_flips_per_minute == pytest.approx(6.0)
    assert figures.duration_s == 60.0


def test_a_change_that_is_never_found_is_counted_and_not_averaged():
    reported = np.repeat([0, 0, 0], 80)
    delay = sequence_figures([track_of(reported, reported)], 0).filter_delay_s
    assert (delay.n_changes, delay.n_missed, delay.p90_of_all) == (2, 1, None)
    assert delay.p90 == 0.25  # back on the ground that it never left
    unknown = np.full(240, -1)
    figures = sequence_figures([track_of(unknown, unknown)], 0)
    assert figures.unknown_ratio == 1.0
    assert figures.filtered_accuracy == 0.0
    assert np.isnan(figures.filter_delay_s.p90)
    assert sequence_figures([], 0) is None


def test_the_interval_covers_the_accuracy_of_unlike_runs():
    rng = np.random.default_rng(2)
    true = np.repeat([0, 1, 0], 80)
    tracks = []
    for i in range(12):
        reported = np.where(rng.random(240) < rng.uniform(0.6, 1.0), true, 2)
        tracks.append(track_of(reported, true)._replace(run=(f"a {i}", f"b {i}", f"c {i}")))
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


def test_breakaways_name_the_run_and_both_terrains():
    probability = np.repeat([[0.9, 0.1], [0.1, 0.9], [0.9, 0.1]], [10, 5, 10], axis=0)
    names = np.array(["a"] * 25, dtype=object)
    labels = np.array(["ice"] * 25, dtype=object)
    windows = Windows({}, {}, {}, 2.0, 2.0 * np.arange(25), names, labels)
    held_out = HeldOut(
        np.array(["ice", "snow"]), probability[None], np.zeros((1, 25), int), labels.astype(str), []
    )
    [found] = breakaways_of(held_out, windows)
    assert (found.run_id, found.start_s, found.end_s) == ("a", 20.0, 30.0)
    assert (found.label, found.looks_like) == ("ice", "snow")


@pytest.mark.slow
def test_crossval_judges_courses_beside_single_windows(drive):
    runs = [
        drive(f"{terrain}_{i}", terrain, 10 * i + len(terrain), 40.0)
        for terrain in ("GRASS", "ASPHALT")
        for i in range(5)
    ]
    settings = EvaluationSettings(repeats=1, n_jobs=1)
    document = as_json(crossval(runs, settings))
    assert document["courses"]["n_courses"] == 5
    assert document["recorded_courses"] is None
    low, high = document["filtered_accuracy_ci"]
    assert 0.0 <= low <= document["filtered_accuracy"] <= high <= 1.0
    assert document["filter_delay_s"]["n_changes"] >= 5
    assert document["courses"]["gain"] >= -0.05
    assert document["breakaways"] == []
    plain = as_json(crossval(runs, EvaluationSettings(repeats=1, n_jobs=1, extras=False)))
    assert "filtered_accuracy" not in plain
    assert plain["accuracy"] == document["accuracy"]
