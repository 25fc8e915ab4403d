"""The studies of the live service measure what they say, and the soak finds what is not accepted."""

import json

import msgpack
import numpy as np
import pytest

from studies import live, soak
from studies.service import messages_of, model_folder, sent_channels, study_drive


@pytest.fixture(scope="module")
def run():
    return study_drive(3)


@pytest.fixture(scope="module")
def uri(tmp_path_factory):
    return model_folder(None, 3, tmp_path_factory.mktemp("study") / "model")


def test_messages_hold_every_sample_of_the_drive_once(run):
    messages, channels = messages_of(run, ahead_s=7.0), sent_channels(run)
    contents = [msgpack.unpackb(one.message) for one in messages]
    for stream in channels:
        sent = [t for one in contents if stream in one["streams"] for t in one["streams"][stream][0]]
        assert sent == pytest.approx(run.streams[stream].time_s + 7.0, abs=1e-9)
    assert [one["time_s"] for one in contents] == [one.time_s for one in messages]
    assert [one.get("step", False) for one in contents] == [one.step for one in messages]
    assert np.diff([one.time_s for one in messages if one.step]) == pytest.approx(0.05, abs=1e-9)
    assert sum(one.rows for one in messages) == sum(len(run.streams[stream]) for stream in channels)


@pytest.mark.slow
def test_the_live_study_has_all_its_figures(uri, monkeypatch):
    monkeypatch.setattr(live, "REPEATS", 1)
    monkeypatch.setattr(live, "N_WINDOWS", 40)
    result = live.run(live.Settings(model=uri, robots=3, seconds=1.5, seed=3))
    document = result.as_json()
    json.dumps(document, allow_nan=False)
    for name in ("step_us", "step_beside_window_us", "step_paced_us", "window_ms", "websocket_ms"):
        assert 0.0 < document[name]["median"] <= document[name]["p99"]
    assert [row["sessions"] for row in document["by_sessions"]] == [2, 3, 5]
    assert [row["lost_samples"] for row in document["by_sessions"]] == [0, 0, 0]
    assert 0.5 < document["start_s"] < 60.0
    assert 50.0 < document["rss_mb"] < 1000.0
    assert "3 robots" in result.report.answer


@pytest.mark.slow
def test_a_short_soak_with_every_fault_is_accepted(uri, monkeypatch):
    monkeypatch.setattr(soak, "FAULTS_PER_MINUTE", 300.0)
    found = soak.run(soak.Settings(model=uri, robots=4, minutes=0.2, seed=5))
    assert found.problems == ()
    assert found.steps > 150
    assert sum(found.faults.values()) >= 20
    assert set(found.faults) <= set(soak.FAULTS)


@pytest.mark.parametrize(
    ("changed", "problem"),
    [
        ({}, ""),
        ({"rss_mb": [300.0, 300.0, 305.0, 310.0, 312.0, 314.0]}, ""),
        ({"rss_mb": [300.0, 300.0, 310.0, 320.0, 330.0, 340.0]}, "memory grew by 11.7%, 5% are accepted"),
        ({"not_finite": 1}, "1 commands were not finite"),
        ({"stale": 2}, "2 commands were stale"),
        ({"wrong_session": 1}, "1 answers were of another robot"),
        ({"unanswered": 3}, "3 steps were not answered"),
        ({"steps": 0}, "no step was answered"),
        ({"problems": ["the service ended by itself"]}, "the service ended by itself"),
    ],
)
def test_what_is_not_accepted_is_named(changed, problem):
    seen = soak._Seen()
    seen.steps, seen.rss_mb = 100, [300.0] * 6
    for name, value in changed.items():
        setattr(seen, name, value)
    judged = soak.judged(soak.Settings(), seen)
    assert list(judged.problems) == ([problem] if problem else [])
    assert judged.refused == problem
    assert problem in judged.report.answer
