"""Adapting to a session, from the window to the command: what is corrected, averaged, saved, shown and refused."""

from dataclasses import replace

import numpy as np
import pytest

from features.windows import cut_windows, join_windows
from pipelines.learn.adaptation import judged_adaptation
from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.predict import predict
from pipelines.live.assess import SessionStart, assess, class_sets
from pipelines.live.model import with_start
from pipelines.live.observer import Observer
from pipelines.live.session import Hello, RobotSession, Served
from terrain.classify.adaptation import START_S, Shift, corrected
from terrain.control.slip_table import load_slip_table
from terrain.errors import ConfigError, DataError
from terrain.logs.replay import replay
from terrain.logs.run_folders import write_run
from terrain.records import Stream

TABLE = load_slip_table()


def heavier(run, gain, run_id=""):
    """A run whose currents are those of a heavier robot."""
    wheels = run.streams["wheels"]
    values = wheels.values * [1.0, 1.0, gain, gain]
    streams = {**run.streams, "wheels": Stream(wheels.time_s, values, wheels.channels)}
    return replace(run, run_id=run_id or run.run_id, streams=streams)


@pytest.fixture(scope="module")
def loads(drive_all):
    """Two terrains that only currents distinguish: 1.6 A on ice, 2.2 A on mud; from one session."""
    runs = []
    for number, (terrain, current_a) in enumerate((("ICE", 1.6), ("MUD", 2.2))):
        runs += drive_all((terrain,), 6, number, level=1.0, smoothness=0.4, current_a=current_a)
    return runs


@pytest.fixture(scope="module")
def fitted(loads):
    return TerrainClassifier("svm").fit(cut_windows(loads).windows)


def test_a_heavier_robot_is_not_taken_for_another_terrain_with_certainty(fitted, loads, drive):
    """1.6 A are 2.2 A of a robot that is 1.35 times as heavy."""
    other = [
        heavier(run, 1.35) for run in (drive("a", "ICE", 50, 40.0, current_a=1.6, level=1.0, smoothness=0.4),)
    ]
    windows = cut_windows(other).windows
    plain = assess(fitted.model_, windows)
    assert (fitted.predict(windows) == "MUD").all()
    assert plain.probability[:, 1].mean() > 0.9
    begun = assess(fitted.model_.at_start(), windows)
    assert begun.probability.max(axis=1).mean() < 0.85
    adapted = fitted.adapt(windows[:8], "ICE")
    assert (adapted.predict(windows[8:]) == "ICE").mean() > 0.8
    assert "from 16 s on ICE" in adapted.model_.adaptation.found
    judged = assess(adapted.model_, windows[8:])
    wrong = (judged.probability[:, 0] < 0.5) & ~judged.unknown
    assert wrong.mean() <= 0.05
    sets = class_sets(adapted.model_, judged.probability)
    assert np.mean(["ICE" in each for each in sets]) > 0.9
    assert fitted.model_.adaptation.shift is None  # the classifier itself is as it was


def test_a_shift_that_is_certain_gives_what_corrected_channels_give(fitted, loads):
    windows, learned = cut_windows(loads[:2]).windows, fitted.model_.adaptation
    theta = np.array([0.3, 0.05, -0.1])
    shift = Shift("ICE", 20.0, np.repeat(theta[None], 2, axis=0), np.zeros((2, 3, 3)))
    certain = fitted.model_._replace(adaptation=learned._replace(shift=shift))
    expected = fitted.predict_proba(corrected(learned, windows, theta))
    assert assess(certain, windows).probability == pytest.approx(expected, abs=1e-12)
    neutral = shift._replace(mean=np.zeros((2, 3)))
    same = fitted.model_._replace(adaptation=learned._replace(shift=neutral))
    assert assess(same, windows).probability == pytest.approx(fitted.predict_proba(windows), abs=1e-9)


def test_what_is_saved_adapts_as_what_was_fitted(fitted, loads, tmp_path):
    windows = cut_windows(loads).windows
    again = TerrainClassifier.load(fitted.save(tmp_path / "field")).adapt(windows[:10], "ICE")
    adapted = fitted.adapt(windows[:10], "ICE")
    assert np.array_equal(again.predict_proba(windows), adapted.predict_proba(windows))
    kept = TerrainClassifier.load(adapted.save(tmp_path / "adapted"))
    assert np.array_equal(kept.predict_proba(windows), adapted.predict_proba(windows))


@pytest.mark.parametrize("terrain", ["", "ICE"])
def test_the_start_of_a_session_adapts_alike_live_in_a_log_and_window_by_window(fitted, drive, terrain):
    run = heavier(drive("a", "ICE", 51, 34.0, current_a=1.6, level=1.0, smoothness=0.4), 1.3)
    model = fitted.model_.at_start(terrain)
    windows = cut_windows([run], model.info.rule, layout=model.info.layout).windows
    together, session = SessionStart(model).assess(windows), SessionStart(model)
    each = [session.assess(windows[i]) for i in range(len(windows))]
    assert session.over
    for name in ("probability", "novelty"):
        assert np.concatenate([getattr(one, name) for one in each]) == pytest.approx(getattr(together, name))
    start = windows.start_s + 2.0 <= START_S
    assert together.probability[start] == pytest.approx(assess(model, windows[start]).probability)
    after = model.adapt(windows[start], terrain)
    assert together.probability[~start] == pytest.approx(assess(after, windows[~start]).probability)
    logged = predict([run], model, TABLE)
    assert logged.adapted == (f"a: {after.adaptation.found}",)
    assert [row.probability for row in logged.windows] == pytest.approx(together.probability.max(axis=1))
    channels = {name: stream.channels for name, stream in run.streams.items()}
    observer = Observer(model, channels=channels)
    outputs = [one for sample in replay(run) for one in observer.update(sample.readings)]
    assert [one.probability for one in outputs] == pytest.approx(together.probability.max(axis=1))
    assert [one.terrain or "unknown" for one in outputs] == [row.terrain for row in logged.windows]
    assert observer.source.adapted == after.adaptation.found
    observer.source.restart()  # the session goes on
    assert observer.source._part.session.model.adaptation.found == after.adaptation.found


def test_a_start_of_too_few_windows_leaves_what_a_session_begins_with(fitted, drive):
    run = drive("a", "ICE", 52, 60.0, current_a=1.6, level=1.0, smoothness=0.4)
    model = fitted.model_.at_start()
    windows = cut_windows([run], model.info.rule, layout=model.info.layout).windows
    few = join_windows([windows[:1], windows[15:]])
    session = SessionStart(model)
    assert session.assess(few).probability == pytest.approx(assess(model, few).probability)
    assert session.model is model


def test_it_is_used_unasked_only_where_held_out_sessions_show_a_gain(drive_all):
    """Sessions of other loads, each on both grounds, show one; sessions alike, each on one ground, do not."""

    def judged(gains, terrains, paused=""):
        runs = []
        for number, gain in enumerate(gains):
            for place, (terrain, current_a) in enumerate(terrains(number)):
                made = drive_all(
                    (terrain,),
                    1,
                    10 * number + place,
                    level=1.0,
                    smoothness=0.4,
                    current_a=current_a,
                    duration_s=30.0,
                )
                runs += [
                    replace(heavier(run, gain, f"{number}_{run.run_id}"), session=f"number {number}")
                    for run in made
                ]
        windows = cut_windows(runs).windows
        windows = windows[(windows.session != paused) | (windows.start_s < 1.0) | (windows.start_s > 22.0)]
        extractor = TerrainClassifier("svm").unfitted(1)[0].fit(windows)
        return judged_adaptation(windows, extractor.transform(windows), extractor.features_of, 1, 0)

    both = (("ICE", 1.6), ("MUD", 2.4))
    gains = [0.75, 1.3, 0.85, 1.2, 0.7, 1.4]
    shown = judged(gains, lambda number: both)
    assert shown.shown, shown.status
    assert shown.status.startswith("shown: log loss")
    paused = judged(gains, lambda number: both, "number 0")  # whose start holds one window
    assert paused.status.endswith("5 sessions held out")
    alike = judged([1.0] * 6, lambda number: both[number % 2 : number % 2 + 1])
    assert not alike.shown, alike.status
    assert alike.status.endswith("6 sessions held out")
    few = judged(gains[:2], lambda number: both)
    assert not few.shown
    assert few.status == "not shown: 2 sessions outlast a start of 20 s, 3 are needed"


def test_what_is_shown_is_used_unless_it_is_switched_off(fitted):
    model = fitted.model_
    shown = model._replace(adaptation=model.adaptation._replace(shown=True))
    assert with_start(model, "", "").adaptation.start is None
    assert with_start(model, "start", "ICE").adaptation.start == "ICE"
    assert with_start(shown, "", "").adaptation.start == ""
    spread = with_start(model, "spread", "").adaptation
    assert (spread.start, spread.found) == (None, "")
    assert np.array_equal(spread.shift.cov, model.at_start().adaptation.shift.cov)
    assert with_start(shown, "none", "").adaptation.start is None
    saved = spread._replace(shift=spread.shift._replace(terrain="ICE"))  # adapted, and saved so
    saved = model._replace(adaptation=saved._replace(shown=True))
    assert with_start(saved, "", "") is saved
    assert with_start(saved, "none", "").adaptation.shift is None
    with pytest.raises(DataError, match="knows no levels of currents or vibration"):
        with_start(model._replace(adaptation=None), "start", "")


def test_a_robot_names_the_ground_that_it_starts_on(fitted, drive):
    run = drive("a", "ICE", 53, 30.0, current_a=1.6, level=1.0, smoothness=0.4)
    streams = {name: stream.channels for name, stream in run.streams.items()}

    def begun(start):
        hello = Hello(session="one", robot="rover", streams=streams, start=start)
        return RobotSession(hello, Served(1, fitted.model_, "test", TABLE), None)

    session = begun("ICE")
    for sample in replay(run):
        for name, reading in sample.readings.items():
            session.put(
                {name: (reading.time_s.tolist(), reading.values.tolist())}, None, 500.0 + sample.time_s
            )
        session.step(500.0 + sample.time_s)
    assert session.content()["adapted"].endswith("from 20 s on ICE")
    assert begun("").content()["adapted"] is None
    with pytest.raises(ConfigError, match="the model has not learned 'TAR'"):
        begun("TAR")


def test_commands_adapt_and_refuse(fitted, loads, drive, terrain, refused, place, tmp_path):
    model = fitted.save(tmp_path / "model")
    for name, gain in (("first", 1.3), ("later", 1.3)):
        run = drive(name, "ICE", len(name), 30.0, current_a=1.6, level=1.0, smoothness=0.4)
        write_run(heavier(run, gain), tmp_path / name)
    words = ("predict", "--data", tmp_path / "later", "--model", model)
    code, out, err = terrain(*words, "--adapt", tmp_path / "first", "--adapt-terrain", "ICE")
    text = " ".join(out.split())
    assert code == 0, err
    assert "times those of training, from 30 s on ICE" in text
    assert "that this helps is not shown" in text
    code, out, err = terrain(*words, "--adapt", "start")
    assert code == 0, err
    assert "on a ground that was not named" in " ".join(out.split())
    refused("the model has not learned 'TAR'", *words, "--adapt", "start", "--adapt-terrain", "TAR")
    refused("--adapt-terrain is the terrain of what --adapt names", *words, "--adapt-terrain", "ICE")
    refused("nowhere", *words, "--adapt", "nowhere")
    refused(
        "--adapt start is required",
        "serve",
        "--model",
        model,
        "--adapt-terrain",
        "ICE",
        "--check",
        "--port",
        "0",
    )
