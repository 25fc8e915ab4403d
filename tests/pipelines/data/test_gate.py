"""One gate for data: what cannot be right is refused by every command in the same sentence, what is doubtful stated."""

import json
from dataclasses import replace

import numpy as np
import pytest

import terrain as face
from pipelines.live.gate import LiveGate
from terrain.errors import DoubtfulRunWarning, LogError
from terrain.files.names import data_folder
from terrain.logs.replay import replay
from terrain.logs.run_folders import write_run
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

HUSKY = ("--robot", "husky")
COMMANDS = {
    "convert": ("convert", "data", "--out", "out"),
    "convert --to csv": ("convert", "data", "--to", "csv", "--out", "out"),
    "estimate": ("estimate", "--data", "data", "--filter", "slip"),
    "calibrate": ("calibrate", "--data", "data", *HUSKY),
    "crossval": ("crossval", "--data", "data"),
    "train": ("train", "--data", "data", "--name", "model"),
    "predict": ("predict", "--data", "data", "--model", "none"),
    "predict --changes": ("predict", "--data", "data", "--changes", "data"),
    "learn-slip": ("learn-slip", "--data", "data", *HUSKY, "--out", "table.yaml"),
    "explain": ("explain", "--data", "data", *HUSKY, "--out", "out"),
    "quickstart": ("quickstart", "--data", "data", "--out", "out"),
}


def with_imu(run, **factors):
    """Return a run with channels of the IMU multiplied."""
    imu = run.streams["imu"]
    values = imu.values * [factors.get(channel, 1.0) for channel in imu.channels]
    return replace(run, streams={**run.streams, "imu": replace(imu, values=values)})


def accel(factor):
    return {f"accel_{axis}_mps2": factor for axis in "xyz"}


SENTENCE = (
    "r: implausible gravity: the mean specific force is 0.981 m/s^2, 9.81 is expected: an accelerometer in g read as "
    "m/s^2? (mend it where it is read, by a mapping, say, or take it as it is, and counted, with --repair)"
)


@pytest.fixture
def in_g(place, drive):
    """The folder to work in, with a run in ``data`` whose accelerometer is in g."""
    write_run(with_imu(drive("r", "GRASS", 0, duration_s=8.0), **accel(1 / 9.81)), place / "data")
    return place


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_an_implausible_run_in_the_same_sentence(refused, in_g, command):
    refused(SENTENCE, *COMMANDS[command])


def test_python_and_a_cache_refuse_it_too(terrain, in_g):
    for _ in range(2):  # read, and from the cache
        code, out, err = terrain("crossval", "--data", "data", "--cache", "cache")
        assert (code, out, err.splitlines()[-1]) == (2, "", f"error: {SENTENCE}")
    with pytest.raises(LogError) as error:
        face.load_runs(in_g / "data")
    assert str(error.value) == SENTENCE


@pytest.mark.parametrize(
    "command", [name for name, words in COMMANDS.items() if "--robot" not in words and name != "quickstart"]
)
def test_every_command_refuses_runs_of_another_robot_than_the_one_described(refused, place, drive, command):
    write_run(replace(drive("r", "GRASS", 0, duration_s=8.0), robot="tractor"), place / "data")
    sentence = "data: run r is of robot 'tractor', --robot describes 'husky': name both alike, or give the other's file"
    refused(sentence, *COMMANDS[command], *HUSKY)


def test_a_run_that_was_taken_as_it_is_is_stated_and_no_longer_refused(terrain, in_g, model_dir):
    """``--repair`` is the one option, of every command; what it decided stays with the run."""
    assert terrain("convert", "data", "--out", "runs", "--repair")[0] == 0
    code, out, _ = terrain("estimate", "--data", "runs", "--filter", "slip", "--json", "found.json")
    assert code == 0
    (stated,) = json.loads((in_g / "found.json").read_text())["doubtful"]
    assert stated == "r: implausible" + SENTENCE.partition("implausible")[2].partition(" (mend")[0]
    assert "implausible gravity" in " ".join(out.split())
    assert dict(face.load_runs(in_g / "runs", repair=True)[0].dropped) == {"implausible gravity": 1}
    code, out, err = terrain("label", "data", "--model", model_dir, "--proposals", "new.csv")
    assert (code, out, err) == (2, "", f"error: {SENTENCE}\n")
    code, out, _ = terrain("serve", "--replay", "data", "--model", model_dir, "--json", "found.json")
    assert (code, "an accelerometer in g" in " ".join(out.split())) == (0, True)  # stated, and not ended
    code, out, _ = terrain("inspect", "data")  # which states and does not refuse
    assert (code, "an accelerometer in g" in " ".join(out.split())) == (0, True)


TILTED = "mostly along +z is expected: a tilted sensor, or a steep slope?"


@pytest.fixture
def tilted(place, drive):
    """The folder to work in, with runs in ``data`` whose IMU is tilted."""
    turn = np.eye(6)
    turn[3:, 3:] = [[np.cos(0.6), 0, -np.sin(0.6)], [0, 1, 0], [np.sin(0.6), 0, np.cos(0.6)]]
    for seed in range(6):
        terrain = ("GRASS", "GRAVEL")[seed % 2]
        run = drive(f"{terrain}_{seed}", terrain, seed, duration_s=16.0)
        imu = run.streams["imu"]
        imu = Stream(imu.time_s, imu.values @ turn.T, imu.channels)
        write_run(replace(run, streams={**run.streams, "imu": imu}), place / "data")
    return place


@pytest.mark.parametrize(
    "words",
    [
        ("convert", "data", "--out", "out"),
        ("inspect", "data"),
        ("estimate", "--data", "data", "--filter", "slip"),
        ("calibrate", "--data", "data", *HUSKY),
        ("crossval", "--data", "data"),
        ("crossval", "--data", "data", "--cache", "cache"),
        ("predict", "--data", "data", "--model", "model"),
        ("label", "data", "--model", "model", "--proposals", "new.csv"),
        ("serve", "--replay", "data", "--model", "model"),
    ],
    ids=lambda words: f"{words[0]} {words[-1]}",
)
def test_every_command_states_the_same_doubt_on_its_screen_and_in_its_result(
    terrain, tilted, model_dir, words
):
    words = [str(model_dir) if word == "model" else word for word in words]
    code, out, err = terrain(*words, "--json", "found.json", "--report", "page.html")
    assert code == 0, err
    assert TILTED in " ".join(out.split())
    assert TILTED in (tilted / "page.html").read_text()
    stated = str(json.loads((tilted / "found.json").read_text()))
    assert stated.count(TILTED) >= 3


def test_runs_of_seconds_are_refused_together_with_a_cache_as_without(terrain, place):
    whole = simulate_run(load_robot("husky"), "grass", "complex", 0, 1, duration_s=40.0)
    for k in range(6):
        streams = {}
        for name in ("imu", "wheels", "odometry"):
            stream = whole.streams[name]
            rows = (stream.time_s >= 6.0 * k) & (stream.time_s < 6.0 * (k + 1))
            factor = 3.6 if name == "odometry" else 1.0
            values = stream.values[rows] * factor
            streams[name] = replace(stream, time_s=stream.time_s[rows], values=values)
        write_run(replace(whole, run_id=f"piece_{k}", streams=streams), place / "data")
    for words in ((), ("--cache", "cache"), ("--cache", "cache")):
        code, out, err = terrain("crossval", "--data", "data", *words)
        assert (code, out) == (2, "")
        assert "piece_0: implausible over 6 runs, speed: that of odometry is 3." in err.splitlines()[-1]


def test_python_warns_of_a_doubt(tilted):
    with pytest.warns(DoubtfulRunWarning, match="a tilted sensor"):
        face.load_runs(tilted / "data")


def test_samples_of_a_robot_that_is_served_are_judged_while_it_drives_and_nothing_is_refused():
    """The same sentence as of a log; once a minute is sound it is withdrawn."""
    run = simulate_run(load_robot("husky"), "grass", "survey", 0, 1, duration_s=110.0)
    gate = LiveGate("husky", {name: stream.channels for name, stream in run.streams.items()}, None)
    sentences = []
    for sample in replay(run, 20.0):
        readings = dict(sample.readings)
        if sample.time_s < 18.0 and (imu := readings.get("imu")) is not None:
            readings["imu"] = imu._replace(values=imu.values / 9.81)
        gate.step(sample.time_s, readings)
        sentences += [gate.sentences]
    assert sentences[0] == sentences[-1] == []
    assert next(filter(None, sentences))[0].endswith("9.81 is expected: an accelerometer in g read as m/s^2?")


def test_a_run_that_is_made_in_python_is_warned_of_and_not_refused(drive):
    with pytest.warns(DoubtfulRunWarning, match="r: implausible gravity: .* an accelerometer in g"):
        face.estimate([with_imu(drive("r", "GRASS", 0, duration_s=8.0), **accel(1 / 9.81))])


@pytest.mark.parametrize(
    "words",
    [
        *(("simulate", "--terrain", "grass", "--scenario", "straight", "--out", "out"),),
        *(
            ("drive", "--terrain", "grass", "--scenario", "starts"),
            ("inspect", "data"),
        ),
        *(("convert", "data", "--out", "out"), ("estimate", "--data", "data", "--filter", "slip")),
        *(("calibrate", "--data", "data"), ("explain", "--data", "data", "--out", "out")),
        *(("crossval", "--data", "data"), ("learn-slip", "--data", "data", "--out", "table.yaml")),
    ],
)
def test_a_robot_whose_sizes_do_not_belong_together_is_refused_by_every_command(refused, place, drive, words):
    text = (data_folder("robots") / "husky.yaml").read_text()
    (place / "mine.yaml").write_text(
        text.replace("wheel_radius_m: {value: 0.165", "wheel_radius_m: {value: 22")
    )
    write_run(drive("r", "GRASS", 0, duration_s=4.0), place / "data")
    refused(
        "mine.yaml: wheel_radius_m is 22, 0.004 to 2.5 m is expected: in cm?", *words, "--robot", "mine.yaml"
    )
