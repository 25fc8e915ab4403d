"""A sound run is plausible, and each usual mistake in it is found, named and measured."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.data.datasets import verdict
from pipelines.data.inspect import Settings as InspectSettings
from pipelines.data.inspect import run as inspect_runs
from terrain.logs.motion_checks import Described
from terrain.logs.plausibility import Level, doubt_sentences, doubts_of, judge, stream_quality, worst
from terrain.logs.run_folders import write_run
from terrain.records import RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

HUSKY = Described(0.5708, 1.0065)
DEGREE = np.pi / 180.0


def sound_run(duration_s=40.0, seed=0):
    """A husky that starts, drives and turns; its wheels skid by half of the turn."""
    rng = np.random.default_rng(seed)
    t, s = np.arange(0.0, duration_s, 0.01), np.arange(0.0, duration_s, 0.1)
    rate = 0.4 * np.sin(0.5 * t) + 0.1
    imu = np.column_stack([np.zeros((len(t), 2)), rate, np.zeros((len(t), 2)), np.full(len(t), 9.81)])
    imu += rng.normal(0.0, [0.02] * 3 + [0.5] * 3, imu.shape)
    turn = 2.0 * np.interp(s, t, rate) * 0.5708 / 2
    wheels = np.column_stack([0.6 - turn, 0.6 + turn, 4.0 - turn, 4.0 + turn]) + rng.normal(
        0, 0.01, (len(s), 4)
    )
    names = (*(f"gyro_{a}_radps" for a in "xyz"), *(f"accel_{a}_mps2" for a in "xyz"))
    sides = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
    return RunLog("SNOW_01", "husky", {"imu": Stream(t, imu, names), "wheels": Stream(s, wheels, sides)})


def with_stream(name, **changes):
    run = sound_run()
    return replace(run, streams={**run.streams, name: replace(run.streams[name], **changes)})


def changed(stream, factors):
    """Return the sound run with some channels of a stream multiplied."""
    old = sound_run().streams[stream]
    return with_stream(stream, values=old.values * [factors.get(name, 1.0) for name in old.channels])


def retimed(factor, names=("imu", "wheels")):
    run = sound_run()
    times = {name: replace(run.streams[name], time_s=run.streams[name].time_s * factor) for name in names}
    return replace(run, streams={**run.streams, **times})


def renamed(stream, old, new):
    channels = sound_run().streams[stream].channels
    return with_stream(stream, channels=tuple(new if name == old else name for name in channels))


def with_axes(order, signs):
    values = sound_run().streams["imu"].values.copy()
    values[:, 3:] = values[:, 3:][:, order] * signs
    return with_stream("imu", values=values)


ACCEL = {f"accel_{axis}_mps2": 1 / 9.81 for axis in "xyz"}
GYRO = {f"gyro_{axis}_radps": 1 / DEGREE for axis in "xyz"}
SPEEDS = ("speed_left_mps", "speed_right_mps")


def test_a_sound_run_is_ok_in_every_respect():
    checks = judge(sound_run(), HUSKY)
    assert {check.level for check in checks} == {Level.OK}, checks
    assert {check.check for check in checks} == {
        *("gravity", "yaw rate", "wheel speed", "sampling", "channel names", "values"),
        *("constant channels", "overlap"),
    }


BAD, ODD = "implausible", "doubtful"
CASES = [
    (changed("imu", ACCEL), "gravity", BAD, "is 1 m/s^2, 9.81 is expected: an accelerometer in g"),
    (changed("imu", dict.fromkeys(ACCEL, 9.81)), "gravity", BAD, "one in m/s^2 read as g"),
    (changed("imu", dict.fromkeys(ACCEL, 0.5)), "gravity", BAD, "another unit, or a scale"),
    (changed("imu", {"accel_z_mps2": 0.0}), "gravity", ODD, "gravity removed"),
    (with_axes([0, 1, 2], [1, -1, -1]), "gravity", BAD, "z points down"),
    (with_axes([2, 0, 1], [1, 1, 1]), "gravity", BAD, "another axis points up"),
    (changed("imu", GYRO), "yaw rate", BAD, "a gyro in deg/s read as rad/s"),
    (changed("imu", {"gyro_z_radps": -1.0}), "yaw rate", BAD, "turned sign of the gyro"),
    (changed("imu", {"gyro_z_radps": 0.1}), "yaw rate", ODD, "wheels that dig in"),
    (changed("wheels", dict.fromkeys(SPEEDS, 3.6)), "wheel speed", ODD, "rad/s or km/h read as m/s"),
    (changed("wheels", dict.fromkeys(SPEEDS, 6.1)), "wheel speed", BAD, "top speed is 1.01 m/s"),
    (retimed(1000.0), "sampling", BAD, "0.1 Hz, 0.5 Hz to 10 kHz is expected: ms read as s"),
    (retimed(0.001), "sampling", BAD, "1e+05 Hz, 0.5 Hz to 10 kHz is expected: s read as ms"),
    (retimed(1000.0, ["wheels"]), "overlap", BAD, "0 % of the longest stream"),
    (retimed(0.3, ["wheels"]), "overlap", ODD, "30 % of the longest stream"),
    (changed("wheels", {"speed_left_mps": 1e300}), "values", BAD, "--repair leaves such values out"),
    (changed("imu", {"gyro_x_radps": 1e5}), "values", ODD, "up to 70 is expected"),
    (changed("imu", {"accel_x_mps2": 0.0}), "constant channels", ODD, "is 0 throughout"),
    (changed("wheels", {"current_left_a": 0.0}), "constant channels", ODD, "is 0 throughout"),
    (renamed("imu", "gyro_z_radps", "gyor_z_radps"), "channel names", BAD, "is it 'gyro_z_radps'"),
    (renamed("imu", "gyro_x_radps", "gyro_x_mps2"), "channel names", BAD, "'radps' is expected"),
    (renamed("imu", "gyro_x_radps", "gyro_u_radps"), "channel names", ODD, "'u' is no axis"),
    (renamed("wheels", "current_left_a", "flux_left_a"), "channel names", ODD, "made of 'flux'"),
]


@pytest.mark.parametrize(("run", "check", "level", "sentence"), CASES, ids=range(len(CASES)))
def test_a_mistake_is_found_named_and_measured(run, check, level, sentence):
    found = [c for c in judge(run, HUSKY) if c.check == check and c.level == level]
    assert any(sentence in c.sentence for c in found), judge(run, HUSKY)
    assert worst(judge(run, HUSKY)) in (Level.DOUBTFUL, Level.IMPLAUSIBLE)


def test_several_mistakes_are_all_named_and_a_sentence_on_many_runs_is_counted():
    run = changed("imu", {**ACCEL, **GYRO})
    checks = [check for check in judge(run, HUSKY) if check.level == Level.IMPLAUSIBLE]
    assert {check.check for check in checks} == {"gravity", "yaw rate"}
    sentences = list(doubt_sentences(doubts_of({f"SNOW_{i:02d}": checks[:1] for i in range(9)})))
    assert len(sentences) == 4
    assert sentences[-1] == "6 more runs: implausible gravity (imu)"


def test_what_cannot_be_judged_is_unknown_and_not_ok():
    stream = Stream([0.0, 1.0], [[3.0], [4.0]], ("temperature_k",))
    levels = {check.check: check.level for check in judge(RunLog("a", "husky", {"weather": stream}))}
    for check in ("gravity", "yaw rate", "wheel speed", "sampling", "constant channels", "overlap"):
        assert levels[check] == Level.UNKNOWN
    standing = changed("wheels", dict.fromkeys((*SPEEDS, "current_left_a", "current_right_a"), 0.0))
    levels = {check.check: check.level for check in judge(standing, HUSKY)}
    assert levels["yaw rate"] == levels["wheel speed"] == Level.UNKNOWN
    assert levels["constant channels"] == Level.OK


@pytest.mark.parametrize(
    ("robot", "terrain", "scenario"),
    [
        *(("agrimaro", "clay", "starts"), ("husky", "grass", "survey")),
        *(("warthog", "asphalt", "stand"), ("marmotte", "grass", "survey")),
    ],
)
def test_simulated_runs_are_plausible(robot, terrain, scenario):
    described = load_robot(robot)
    run = simulate_run(described, terrain, scenario, 3, 1, duration_s=15.0)
    odd = [c for c in verdict(run, described) if c.level in (Level.DOUBTFUL, Level.IMPLAUSIBLE)]
    assert not odd


SETS = ("borealtc", "vulpi", "drive_warthog_terrains/sand_1")
LARGE = ("drive_husky", "drive_marmotte", "drive_recordings")


@pytest.mark.parametrize("name", [*SETS, *(pytest.param(name, marks=pytest.mark.slow) for name in LARGE)])
def test_no_measured_run_is_implausible(measured_runs, name):
    robot = {"drive_warthog_terrains/sand_1": "warthog", "drive_marmotte": "marmotte"}.get(name)
    runs = measured_runs(name, robot=robot)
    doubts = doubts_of({run.run_id: verdict(run) for run in runs})
    assert not [doubt for doubt in doubts if doubt.check.level == Level.IMPLAUSIBLE]
    assert len(doubts) <= 0.02 * len(runs)
    if name in ("borealtc", "vulpi"):
        quality = [stream_quality(stream) for run in runs for stream in run.streams.values()]
        assert all((each.stuck, each.n_gaps) == ((), 0) and each.jitter_s < 1e-6 for each in quality)
    # the same runs with a usual mistake are found out: the verdict is no constant
    for run in [run for run in runs if "imu" in run.streams][::10]:
        turned = replace(run.streams["imu"], values=-run.streams["imu"].values)
        checks = verdict(replace(run, streams={**run.streams, "imu": turned}))
        assert any(c.check == "gravity" and c.level == Level.IMPLAUSIBLE for c in checks)


def test_inspect_has_every_check_and_its_figure(tmp_path):
    write_run(changed("imu", GYRO), tmp_path / "data")
    [run] = inspect_runs(InspectSettings(data=tmp_path / "data")).runs
    [check] = [c for c in run.plausibility if c.check == "yaw rate"]
    assert (check.level, check.measured) == ("implausible", pytest.approx(0.5 / DEGREE, rel=0.1))


# -- Shape of a stream: gaps, stuck channels, missing samples --------------------------------------------------


@pytest.fixture
def wheels():
    rng = np.random.default_rng(0)
    speeds = np.round(0.5 + 0.05 * rng.standard_normal((300, 2)), 2)
    currents = np.round(np.abs(rng.standard_normal((300, 2))), 2)
    names = ("speed_left_mps", "speed_right_mps", "current_left_a", "current_right_a")
    return Stream(np.arange(300) / 6.5, np.hstack([speeds, currents]), names)


def hold(stream, channel, first, last):
    values = stream.values.copy()
    values[first:last, stream.channels.index(channel)] = values[first, stream.channels.index(channel)]
    return Stream(stream.time_s, values, stream.channels)


def test_a_channel_is_stuck_where_it_freezes_and_not_where_it_rests(make_run, wheels):
    """A wheel only while the other side moves; a current, which has a floor, only for the whole run."""
    imu = make_run().streams["imu"]
    dead = wheels.values * [np.nan, 1, 1, 1]
    for stream, stuck in (
        (imu, ()),
        (hold(imu, "accel_y_mps2", 50, 60), ()),
        (hold(imu, "accel_y_mps2", 50, 80), ("accel_y_mps2",)),
        (wheels, ()),
        (hold(wheels, "speed_left_mps", 100, 180), ("speed_left_mps",)),
        (hold(hold(wheels, "speed_left_mps", 0, 300), "speed_right_mps", 0, 300), ()),
        (hold(wheels, "current_left_a", 100, 180), ()),
        (hold(wheels, "current_left_a", 0, 300), ("current_left_a",)),
        (replace(wheels, values=dead), ()),
    ):
        assert stream_quality(stream).stuck == stuck
    frozen = stream_quality(hold(imu, "accel_y_mps2", 50, 80))
    assert frozen.longest_constant_s["accel_y_mps2"] == pytest.approx(0.58)
    assert stream_quality(replace(wheels, values=dead)).n_nonfinite["speed_left_mps"] == 300


def test_gaps_and_missing_samples_are_counted_and_placed(wheels):
    values = wheels.values.copy()
    values[[3, 7], 1] = np.nan
    kept = np.delete(np.arange(300), [20, 100, 101, 102])
    quality = stream_quality(Stream(wheels.time_s[kept], values[kept], wheels.channels))
    assert quality.n_gaps == 2
    assert quality.longest_gap_s == pytest.approx(4 / 6.5)
    assert quality.longest_gap_at_s == pytest.approx(99 / 6.5)
    assert [*quality.n_nonfinite.values()] == [0, 2, 0, 0]
    assert quality.rate_hz == pytest.approx(6.5)
