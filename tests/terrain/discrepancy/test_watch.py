"""A robot is watched: quiet drives raise no more alarms than stated, hidden changes are found, live equals log."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy.runs import in_order
from terrain.discrepancy.watch import (
    BESIDE,
    BLOCK_S,
    OVERSHOOT,
    REFERENCE,
    Block,
    BlockDeviation,
    Status,
    Watch,
    Watched,
    _deviation,
    barrier,
    blocks_of,
    read_watched,
    simulation_of,
    watch_lines,
    watched_on,
)
from terrain.errors import ConfigError
from terrain.logs.replay import replay
from terrain.records import Reading, RunLog, Stream
from terrain.robots import Region, description_file, load_robot

HUSKY = load_robot("husky")


@pytest.fixture(scope="module")
def watched(hide):
    """A husky with the deviations of twelve quiet runs."""
    return watched_on(hide({}, n=12, seed=3), HUSKY, "twelve quiet runs")


def watch_runs(watched, runs, **settings):
    """Return the watch after runs, and the time of driving when the first alarm was raised."""
    watch, driven_s, first_s = Watch(watched, **settings), 0.0, np.nan
    for run in runs:
        watch.begin(run.run_id)
        for sample in replay(run, 5.0):
            watch.step(sample.readings)
            if watch.raised and np.isnan(first_s):
                first_s = driven_s + watch.raised[0].raised_s
        driven_s += run.end_s
    return watch, first_s


def test_time_between_false_alarms_is_that_of_the_formula_and_of_simulated_sums():
    stated, n = 300.0, 4000
    threshold, rng = barrier(stated, REFERENCE) - OVERSHOOT, np.random.default_rng(1)
    total, lengths, running = np.zeros(n), np.zeros(n), np.ones(n, bool)
    while running.any():
        total = np.maximum(total + rng.normal(size=n) - REFERENCE, 0.0)
        lengths += running
        running &= total < threshold
    assert lengths.mean() == pytest.approx(stated, rel=4.0 / np.sqrt(n))


def quiet_figures(rng, n, correlation, tails):
    """Return figures and sizes of blocks that are alike when they follow each other; ``tails`` of a t distribution."""
    e = rng.uniform(5.0, 20.0, n)
    z = rng.standard_t(tails, n) / np.sqrt(tails / (tails - 2.0))
    for i in range(1, n):
        z[i] = correlation * z[i - 1] + np.sqrt(1.0 - correlation**2) * z[i]
    return z * np.sqrt(0.01 + 0.002 * e), e


def false_alarms_per_hour(rng, n, correlation, tails, session_std, session_noise=0.0, hours=5):
    """Return the rate of one figure whose deviation is that of n quiet blocks, of five sessions where they differ."""
    sessions = 5 if session_std or session_noise else 1

    def of_session(figure, e):
        return np.exp(session_noise * rng.normal()) * figure + session_std * rng.normal() * np.sqrt(
            0.01 + 0.002 * e
        )

    quiet = []
    for session in range(sessions):
        figure, e = quiet_figures(rng, n // sessions, correlation, tails)
        quiet += [(str(session), *each) for each in zip(of_session(figure, e), e, e, strict=True)]
    of = "yaw_rate_radps", "along"
    watch = Watch(Watched(HUSKY, 20.0, {of: _deviation(quiet, "along")}, ""), false_alarm_h=1.0)
    for _ in range(hours):
        figure, e = quiet_figures(rng, int(3600 / BLOCK_S), correlation, tails)
        for each in zip(of_session(figure, e), e, e, strict=True):
            watch.take(Block(0.0, Status.AGREES, figures={of: each}))
    return len(watch.alarms) / hours


@pytest.mark.parametrize(
    "about",
    [
        (100, 0.3, 50, 0.0),
        pytest.param((30, 0.3, 50, 0.0), marks=pytest.mark.slow),
        pytest.param((100, 0.6, 50, 0.0), marks=pytest.mark.slow),
        pytest.param((100, 0.3, 4, 0.0), marks=pytest.mark.slow),
        pytest.param((200, 0.3, 50, 0.5), marks=pytest.mark.slow),
        pytest.param((200, 0.3, 50, 0.0, 0.5), marks=pytest.mark.slow),
    ],
)
def test_no_more_false_alarms_than_stated(about):
    """The mean over deviations that are each stated from few blocks; one an hour is stated."""
    rng = np.random.default_rng(5)
    assert np.mean([false_alarms_per_hour(rng, *about) for _ in range(12)]) <= 1.0


def test_quiet_drives_agree(hide, watched):
    watch, _ = watch_runs(watched, hide({}, n=12, seed=11))
    assert not watch.alarms
    assert Status.AGREES in watch.status.values()


@pytest.mark.parametrize(
    ("hidden", "channel", "size"),
    [
        ({"wheel_radius_ratio": -0.05}, "speed_x_mps", -0.05),
        ({"effective_track_ratio": 0.15}, "yaw_rate_radps", 1 / 1.15 - 1),
        ({"gyro_scale_ratio": 0.05}, "yaw_rate_radps", 0.05),
        ({"payload_ratio": 0.4}, "current_a", 0.25),
    ],
)
def test_a_hidden_change_is_found(hide, watched, hidden, channel, size):
    watch, first_s = watch_runs(watched, hide(hidden, n=12, seed=12))
    assert first_s < 300.0
    sizes = [alarm.size for alarm in watch.alarms if (alarm.channel, alarm.kind) == (channel, "along")]
    assert sizes == [pytest.approx(size, rel=0.2, abs=0.03)]  # runs differ by some hundredths


def test_an_alarm_is_held_until_the_departure_is_over(hide, watched):
    changed, quiet = hide({"gyro_scale_ratio": 0.1}, n=8, seed=12), hide({}, n=12, seed=13)
    watch, _ = watch_runs(watched, [*changed, *quiet])
    assert watch.alarms
    for alarm in watch.alarms:
        assert alarm.run_id in [run.run_id for run in changed]
        assert np.isfinite(alarm.over_s)
        # it ends in a run that is quiet, by the clock of that run
        assert alarm.over_run_id in [run.run_id for run in quiet]
        assert alarm.over_s < max(run.end_s for run in quiet)
    assert not watch.current


def test_an_alarm_ends_as_soon_after_an_hour_as_after_a_minute():
    of = "speed_x_mps", "along"
    each = BlockDeviation(0.0, 1.0, 0.0, 1.0, 1.0, 0.25, 0.0, 50, 1)
    quiet, changed = ({of: (figure, 1.0, 1.0)} for figure in (0.0, 5.0))
    over_s = []
    for n in (20, 1200):
        watch = Watch(Watched(HUSKY, 20.0, {of: each}, ""))
        for k in range(n + 40):
            watch.take(Block(BLOCK_S * k, Status.AGREES, figures=changed if k < n else quiet))
        (alarm,) = watch.alarms
        assert alarm.since_s == 0.0
        assert alarm.size == pytest.approx(5.0)
        over_s.append(alarm.over_s - BLOCK_S * n)
    assert over_s[0] == over_s[1] < 100.0


@pytest.fixture(scope="module")
def long_run(hide):
    return hide({"gyro_scale_ratio": 0.1}, n=1, duration_s=60.0, seed=14)[0]


def test_live_is_the_log_however_samples_come(watched, long_run):
    blocks = blocks_of(long_run, simulation_of(HUSKY), watched.clock_hz)
    assert sum(block.status is Status.AGREES for block in blocks) > 15
    for rate_hz in (1.0, 20.0):
        watch, live = Watch(watched), []
        for sample in replay(long_run, rate_hz):
            live += watch.step(sample.readings)
        assert live == blocks[: len(live)]
        assert len(live) >= len(blocks) - 1


def without(run, stream, start_s, end_s):
    """The run, whose stream has no samples from start to end."""
    old = run.streams[stream]
    kept = (old.time_s < start_s) | (old.time_s > end_s)
    return RunLog(
        run.run_id,
        run.robot,
        {**run.streams, stream: Stream(old.time_s[kept], old.values[kept], old.channels)},
    )


@pytest.mark.parametrize("stream", ["imu", "odometry", "wheels"])
def test_a_sensor_that_is_silent_is_no_alarm(hide, watched, stream):
    run = hide({}, n=1, duration_s=60.0, seed=15)[0]
    watch = Watch(watched)
    for sample in replay(without(run, stream, 20.0, 40.0), 5.0):
        watch.step(sample.readings)
        if stream != "wheels" and sample.time_s == pytest.approx(38.0, abs=0.1):
            silent = [name for name, status in watch.status.items() if status is Status.SILENT]
            assert silent == (
                ["yaw_rate_radps", "accel_x_mps2"] if stream == "imu" else ["speed_x_mps", "speed_y_mps"]
            )
    assert not watch.alarms
    assert Status.SILENT not in watch.status.values()


def test_standstill_and_what_was_not_validated_are_no_alarm(hide, watched):
    run = hide({}, n=1, duration_s=20.0, seed=15)[0]
    wheels = run.streams["wheels"]
    for factor, status in ((0.0, Status.STANDS), (3.0, Status.OUTSIDE)):
        values = factor * wheels.values
        changed = {**run.streams, "wheels": Stream(wheels.time_s, values, wheels.channels)}
        region = Region((-1.0, 1.0), (-2.0, 2.0), None, ())
        watch = Watch(replace(watched, robot=replace(HUSKY, region=region)))
        for sample in replay(RunLog("a", "husky", changed), 5.0):
            watch.step(sample.readings)
        assert set(watch.status.values()) == {status}
        assert not watch.alarms


@pytest.mark.parametrize("values", [np.nan, np.inf, 1e300])
def test_nonsense_is_no_alarm_and_raises_nothing(watched, long_run, values):
    channels = {name: stream.channels for name, stream in long_run.streams.items()}
    watch = Watch(watched, channels)
    for sample in replay(long_run, 5.0):
        watch.step({name: Reading(t, np.full(x.shape, values)) for name, (t, x) in sample.readings.items()})
    wheels = np.zeros((1, len(channels["wheels"])))
    watch.step({"wheels": Reading(np.array([np.nan]), wheels), "imu": Reading(np.empty(0), np.empty((0, 9)))})
    watch.step({"wheels": Reading(np.array([1e12]), wheels), "unknown": Reading(np.zeros(1), wheels)})
    assert not watch.alarms


def test_what_the_model_is_usually_off_by_is_no_departure(hide):
    """A model without the tenth that its robot turns less is watched as well as the right one."""
    usual = {"effective_track_ratio": 0.1}
    watched = watched_on(hide(usual, n=12, seed=3), HUSKY, "a robot that turns less")
    assert watched.deviations["yaw_rate_radps", "along"].bias == pytest.approx(1 / 1.1 - 1, abs=0.02)
    assert not watch_runs(watched, hide(usual, n=12, seed=11))[0].alarms
    watch, _ = watch_runs(watched, hide({}, n=12, seed=12))
    sizes = [
        alarm.size for alarm in watch.alarms if (alarm.channel, alarm.kind) == ("yaw_rate_radps", "along")
    ]
    assert sizes == [pytest.approx(0.1, rel=0.3)]


# -- Measured runs ----------------------------------------------------------------------------------------------

DRIVE_HUSKY = {
    "effective_track_ratio": 1.4,
    "clock_offset_s": -0.33,
    "camera_latency_s": 0.23,
    "lever_x_m": -0.25,
}


@pytest.mark.slow
def test_measured_runs_agree_with_what_others_of_them_show_and_a_changed_gyro_departs(measured_runs):
    runs = in_order(measured_runs("drive_husky"))
    robot = replace(HUSKY, effects=DRIVE_HUSKY, effects_cov=np.full((4, 4), np.nan))
    held_out = runs[3::4]
    watched = watched_on([run for run in runs if run not in held_out], robot, "three quarters of the runs")
    assert not watch_runs(watched, held_out)[0].alarms
    changed = []
    for run in held_out:
        imu = run.streams["imu"]
        values = imu.values * np.where(np.array(imu.channels) == "gyro_z_radps", 1.2, 1.0)
        changed.append(replace(run, streams={**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}))
    watch, first_s = watch_runs(watched, changed)
    alarm = watch.alarms[0]
    assert first_s < 120.0  # of 50 commands of 6 s
    assert (alarm.channel, alarm.kind, alarm.size) == (BESIDE, "along", pytest.approx(0.2, rel=0.4))


# -- The section of a description ------------------------------------------------------------------------------


@pytest.fixture
def described(tmp_path):
    """Return a function that writes a husky with a section ``watch``."""

    def write(section):
        path = tmp_path / "extended.yaml"
        path.write_text(description_file("husky").read_text(encoding="utf-8") + section, encoding="utf-8")
        return path

    return write


def test_a_section_is_read_as_it_was_written(described, watched):
    read = read_watched(described("\n".join(watch_lines(watched))))
    assert read.robot.name == "husky"
    assert read.deviations.keys() == watched.deviations.keys()
    for of, each in watched.deviations.items():
        assert read.deviations[of] == pytest.approx(each, rel=1e-6)


HEAD = "watch:\n  schema: 1\n  source: me\n  clock_hz: 20\n  deviations:\n"
ENTRY = "{bias: -0.1, noise: 1.0, scatter: 0.0, memory: 1.0, spread: 1.0, offset: 0.1, least: 0.0, blocks: 9"
ENTRY += ", sessions: 2}"


@pytest.mark.parametrize(
    ("section", "sentence"),
    [
        ("", "extended.yaml: has no section 'watch'"),
        ("watch: 3\n", "watch"),
        ("watch: {schema: 1}\n", "watch"),
        (f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("schema: 1", "schema: 2"), "reads 1"),
        (f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("20", "fast"), "a clock of 1 to 50 Hz"),
        (f"{HEAD}    speed_x_mps: {ENTRY}\n", "'speed_x_mps' is no channel and kind"),
        (f"{HEAD}    speed level: {ENTRY}\n", "'speed level' is no channel and kind"),
        (HEAD, "one by channel and kind is required"),
        (f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("0.1", "-1"), "finite numbers are required"),
        (
            f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("noise: 1.0", "noise: .nan"),
            "finite numbers are required",
        ),
        (f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("noise: 1.0", "noise: 0"), "above 0 are required"),
        (f"{HEAD}    speed_x_mps level: {ENTRY}\n".replace("noise: 1.0, ", ""), "noise"),
    ],
)
def test_a_section_that_is_not_accepted_is_one_sentence(described, section, sentence):
    with pytest.raises(ConfigError) as refused:
        read_watched(described(section))
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)
