"""Small labelled runs with a known truth, and one trained model for all tests that need one."""

import math
import shutil
import sqlite3
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from features.windows import cut_windows
from pipelines.cli import main as cli
from pipelines.data.can_frames import QUATERNION, RECEIVED, SIGNALS, encode
from pipelines.learn.model_file import read_model
from pipelines.learn.training_data import data_of_runs, fitted_model
from pipelines.live.model import TerrainModel
from terrain.angles import wrapped
from terrain.estimation.estimate import enriched, estimate_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run


@pytest.fixture(scope="module")
def browser():
    """A headless browser; skips, by name, where there is none."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("chromium is not installed")
    with playwright.sync_playwright() as started:
        found = started.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield found
        found.close()


@pytest.fixture
def terrain(monkeypatch, capfd):
    """Return a function that runs the command in this process: exit code, stdout and stderr."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["terrain", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            cli.main()
        output = capfd.readouterr()
        return stop.value.code or 0, output.out, output.err

    return run


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder to work in, with no tracking server named."""
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    (tmp_path / "place").mkdir()
    monkeypatch.chdir(tmp_path / "place")
    return tmp_path / "place"


@pytest.fixture
def refused(terrain, place):
    """Return a function that asserts that a command is refused in one clear sentence and touches nothing."""

    def check(sentence, *words):
        before = files_of(place)
        code, out, err = terrain(*words)
        assert (code, out) == (2, "")
        assert err.startswith("error: "), err
        assert err.count("\n") == 1, err
        assert err[:-1].isprintable()
        assert len(err) < 1100
        assert sentence in err
        after = files_of(place)
        assert {path: after.get(path) for path in before} == before
        new = {path for path in after if path not in before}
        assert {path.name for path in new} <= {"mlruns"}  # an empty folder, to see that it can be written
        assert all(after[path] is None for path in new)

    return check


def files_of(folder):
    """Return what lies under a folder, with the content of files."""
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


@pytest.fixture(scope="session")
def windows(runs):
    """The windows of ``runs`` by the default rule."""
    return cut_windows(runs).windows


@pytest.fixture(scope="session")
def settings():
    """Return a maker of settings for one process, one repeat and no extras unless asked for."""
    from pipelines.learn.settings import EvaluationSettings

    def make(**options):
        if isinstance(options.get("recipe"), str):
            options["recipe"] = (options["recipe"],)
        return EvaluationSettings(**({"repeats": 1, "extras": False, "n_jobs": 1} | options))

    return make


@pytest.fixture(scope="session")
def tracked(tmp_path_factory, runs):
    """A folder in which a model ``drawn`` has been trained with the embedded tracking, and the result.

    Made once: a new tracking database costs seconds.  ``model/`` beside ``mlruns/`` is the model by itself.
    """
    from sqlalchemy import Engine, event

    from pipelines.learn.train import TrainingSettings, train

    @event.listens_for(Engine, "connect")
    def wait_for_no_disk(connection, _):  # in each of the two hundred commits of a new database
        with suppress(sqlite3.DatabaseError):
            connection.execute("PRAGMA synchronous=OFF")

    folder = tmp_path_factory.mktemp("tracked")
    asked = TrainingSettings(name="drawn", repeats=1, n_jobs=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MLFLOW_TRACKING_URI", raising=False)
        patch.chdir(folder)
        result = train(data_of_runs(runs, asked), asked, "twelve runs")
    (model,) = (folder / "mlruns").rglob("model.skops")
    shutil.copytree(model.parent, folder / "model")
    return folder, result


@pytest.fixture(scope="session")
def model(tracked):
    """The model that ``tracked`` has trained."""
    return read_model(tracked[0] / "model")


@pytest.fixture(scope="session")
def giving(model):
    """Return a function that makes a model like ``model``, whose outputs are those of a function of windows."""
    classes = np.array(model.info.classes)
    return lambda outputs: TerrainModel(SimpleNamespace(classes_=classes, predict_proba=outputs), model.info)


@pytest.fixture
def in_tracked(tracked, monkeypatch):
    """Work in the folder of ``tracked``; the result of the training is given."""
    folder, result = tracked
    monkeypatch.chdir(folder)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return result


@pytest.fixture
def model_dir(tracked, tmp_path):
    """A model folder of one's own to spoil."""
    return Path(shutil.copytree(tracked[0] / "model", tmp_path / "model"))


@pytest.fixture(scope="session")
def trained():
    """What trains a model on labelled runs, with the default settings."""
    return partial(fitted_model, dataset="drawn")


@pytest.fixture(scope="session")
def swerve_model(trained):
    """Trained on what a filter adds to simulated runs of two terrains."""
    robot = load_robot("agrimaro")
    runs = [
        simulate_run(robot, terrain, "survey", 5, number, duration_s=25.0)
        for terrain in ("grass", "tiles")
        for number in (1, 2)
    ]
    return trained([enriched(estimate_run(run, robot, "vio15")) for run in runs])


def as_sent(stream, values):
    """Return the values of a sample as they are sent: angles within half a turn, a real part not negative."""
    sent = [float(value) for value in values]
    for column, channel in enumerate(SIGNALS[stream]):
        if stream in ("steering", "imu") and channel.endswith("_rad") and math.isfinite(sent[column]):
            sent[column] = float(wrapped(sent[column]))
    if stream == "odometry" and sent[QUATERNION[3]] < 0.0:
        for column in QUATERNION:
            sent[column] = -sent[column]
    return sent


def run_frames(layout, run):
    """Return the frames that carry a run's sensors and its desired twist, in the order of their stamps."""
    frames = []
    for name in RECEIVED:
        stream = run.streams.get("commands" if name == "twist" else name)
        if stream is None:
            continue
        places = [
            stream.channels.index(channel) if channel in stream.channels else -1 for channel in SIGNALS[name]
        ]
        rows = np.column_stack([stream.values, np.full(len(stream), np.nan)])[:, places]
        for number, (time_s, row) in enumerate(zip(stream.time_s.tolist(), rows.tolist(), strict=True)):
            frames += encode(layout, name, as_sent(name, row), number, time_s)
    return sorted(frames, key=lambda frame: frame.timestamp)


@pytest.fixture(scope="session", name="as_sent")
def _as_sent():
    return as_sent


@pytest.fixture(scope="session", name="run_frames")
def _run_frames():
    return run_frames


@pytest.fixture(scope="session")
def two_drives():
    """Runs of a robot without a description on two terrains that differ in shaking."""
    rng = np.random.default_rng(1)
    runs = []
    for terrain, noise in (("a", 0.1), ("b", 2.0)):
        for number in range(3):
            time_s = np.arange(0, 12, 0.02)
            shaking = rng.normal(0, noise, (time_s.size, 1))
            speed = np.full((time_s.size, 1), 0.5)
            streams = {
                "imu": Stream(time_s, shaking, ("accel_z_mps2",)),
                "wheels": Stream(time_s, speed, ("speed_left_mps",)),
            }
            runs.append(RunLog(f"{terrain}{number}", "mower", streams, ((0.0, 12.0, terrain),)))
    return runs


@pytest.fixture(scope="session")
def mower_model(trained, two_drives):
    return trained(two_drives)
