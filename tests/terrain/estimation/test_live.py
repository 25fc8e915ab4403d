"""Live by every filter and observer: the batch's numbers, late samples as those in time, sense whatever comes."""

import re
from collections import defaultdict
from dataclasses import replace
from functools import cache
from itertools import cycle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.errors import ConfigError
from terrain.estimation.clocks import QUEUE
from terrain.estimation.feed import GNSS_ROWS, ROWS, measurement_table
from terrain.estimation.filter import GATE_PROBABILITY, REOPEN_AFTER_S, FilterSettings, run_filter
from terrain.estimation.live import CHANNELS, REWIND_S, make_live_filter
from terrain.estimation.models.choice import OBSERVERS, make_observer
from terrain.estimation.models.observer import ObserverStatus, observe, rows_of
from terrain.estimation.models.slip_model import SlipModel
from terrain.estimation.models.swerve import make_filter, scheduled, statuses
from terrain.estimation.wheel_slip import wheel_slip
from terrain.extension import OUTSIDE_S
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.replay import replay
from terrain.records import Reading, Stream
from terrain.robots import Region, load_robot
from terrain.simulation.plants.tracks import PrescribedSlip
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import Faults
from terrain.simulation.sensors import Gnss

ROBOT, HUSKY, UGV = (load_robot(name) for name in ("agrimaro", "husky", "orchard_ugv"))
ODD = ROBOT.with_parts(
    sensors=replace(
        ROBOT.sensors,
        gyro_bias_z_radps=0.01,
        accel_bias_x_mps2=0.1,
        accel_bias_y_mps2=-0.05,
        accel_scale_x_ratio=1.02,
        accel_scale_y_ratio=0.97,
        imu_latency_s=0.02,
    ),
    steering=replace(ROBOT.steering, zero_1_rad=3.0, zero_2_rad=-2.0, zero_3_rad=0.5),
    camera=replace(ROBOT.camera, time_constant_s=0.08, lever_x_m=0.1, latency_s=0.03),
)
IDEAL = ROBOT.with_parts(sensors=replace(ROBOT.sensors, encoder_time_constant_s=0.0))


@cache
def log(scenario="straight", duration_s=16.0, gnss=False, seed=3, faults=None):
    sensors = {"faults": faults or Faults(), "gnss": Gnss() if gnss else None}
    return simulate_run(ROBOT, "grass", scenario, seed, duration_s=duration_s, **sensors)


@cache
def skid_log(scenario="survey", soil="grass", duration_s=18.0):
    return simulate_run(HUSKY, soil, scenario, 31, duration_s=duration_s)


@cache
def tracked_log():
    speeds = 0.5 + 0.2 * np.sin(np.arange(801)[:, None] / [50.0, 70.0])
    run = simulate(UGV, speeds, PrescribedSlip(0.85, 0.8), 4)
    return replace(run, streams={name: stream for name, stream in run.streams.items() if name != "pose"})


LOGS = {"agrimaro": log, "husky": skid_log, "orchard_ugv": tracked_log}


def channels_of(run):
    return {name: stream.channels for name, stream in run.streams.items()}


def made(robot=ROBOT, name="vio15", channels=None, **options):
    """Return an estimator of a robot, by default for the columns of its log."""
    channels = channels or channels_of(LOGS[robot.name]())
    return make_live_filter(name, robot, channels, **options)


def settled(estimator, steps):
    """Return the estimates of steps, to the last one."""
    estimates = [estimate for readings in steps for estimate in estimator.step(readings)]
    return estimates + estimator.settle(all_of_them=True)


GATES = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)


def column(estimates, name):
    return np.array([getattr(estimate, name) for estimate in estimates], dtype=float)


def batch(run, robot=ROBOT, name="vio15", yaw=None):
    """Return times, what is compared of each tick by the name in a live estimate, and counts of a whole log."""
    if name in OBSERVERS:
        observer = make_observer(name, robot, SlipModel())
        time_s, rows, dropped = rows_of(run, robot, observer.rows)
        track = observe(observer, time_s, rows)
        compared = ("mean", "std", "slip", "status")
        return time_s, {what: getattr(track, what) for what in compared}, {**dropped, **observer.dropped}
    table = measurement_table(run, robot, causal=True, initial_yaw_rad=yaw or 0.0)
    model = make_filter(name, robot, yaw is not None)
    samples = scheduled(model, table.z, table.gnss_variance)
    track = run_filter(model, table.time_s, table.columns(model.rows), GATES, *samples)
    table = table.at(track.time_s)
    slip = wheel_slip(track, table, robot)
    desired = {name: track.state(name) for name in ("speed_x_mps", "accel_y_mps2", "yaw_rate_radps")}
    desired |= {"slip_ratio": slip.mean, "slip_std": slip.std, "slip_stale": slip.stale}
    known = [row for row in table.rows if row not in GNSS_ROWS or yaw is not None]
    desired |= dict(zip(known, table.columns(known).T, strict=True))
    desired |= {"mean": track.mean, "reference_age_s": track.reference_age_s}
    desired |= {"status": statuses(model, track.use, table.z, track.reference_age_s)}
    desired |= {"std": np.column_stack([track.std(state) for state in track.states])}
    return track.time_s, desired, {**table.dropped, **track.dropped}


def assert_equal(run, robot=ROBOT, name="vio15", yaw=None, replay_hz=50.0):
    """Compare everything at every tick, to the last bit but of a swerve robot; return the live estimates."""
    estimator = made(robot, name, channels_of(run), **({} if yaw is None else {"initial_yaw_rad": yaw}))
    estimates = settled(estimator, (sample.readings for sample in replay(run, replay_hz)))
    time_s, desired, dropped = batch(run, robot, name, yaw)
    np.testing.assert_array_equal(column(estimates, "time_s"), time_s)
    close = 1e-9 if robot.drive == "swerve" else 0.0
    rows = column(estimates, "rows") if name not in OBSERVERS else None
    for what, expected in desired.items():
        found = rows[:, ROWS.index(what)] if what in ROWS else column(estimates, what)
        np.testing.assert_allclose(found, expected, rtol=0, atol=close, err_msg=what)
    assert counted(estimator.dropped, "clock|time|stamp") == counted(dropped, "clock|time|stamp")
    return estimates


def counted(counts, but_for):
    return {kind: n for kind, n in counts.items() if not re.search(but_for, kind)}


@pytest.mark.parametrize(
    ("scenario", "duration_s", "robot", "name", "yaw"),
    [
        ("survey", 24.0, ROBOT, "vio15", None),
        ("complex", 28.0, ODD, "vio15", None),
        ("complex", 28.0, ROBOT, "vio15", 0.0),
        ("arc", 12.0, IDEAL, "vio15", None),
        ("arc", 12.0, ROBOT, "vio12", None),
        ("straight", 8.0, ROBOT, "encoder12", 0.1),
    ],
)
def test_a_swerve_robot_live_equals_batch(scenario, duration_s, robot, name, yaw):
    """Columns go by name: those of some logs are in reversed order."""
    run = log(scenario, duration_s, gnss=yaw is not None)
    if scenario == "arc":
        turned = {n: Stream(s.time_s, s.values[:, ::-1], s.channels[::-1]) for n, s in run.streams.items()}
        run = replace(run, streams=turned)
    estimates = assert_equal(run, robot, name, yaw)
    wheels = with_wheel_speeds(run, robot).streams["wheels"]
    for what, pattern in (("wheel_speed_mps", "speed_{}_mps"), ("current_a", "current_{}_a")):
        raw = np.column_stack([wheels.channel(pattern.format(i)) for i in (1, 2, 3)])
        np.testing.assert_array_equal(column(estimates, what), raw)


def test_others_live_equal_batch_whatever_comes_together():
    few = make_live_filter("vio15", ROBOT, {"wheels": CHANNELS["wheels"][:3]})
    few.step({"wheels": Reading(np.array([0.0]), np.ones((1, 3)))})
    assert np.isnan(few.latest.current_a).all()
    assert_equal(skid_log("complex", "tilled_loam", 24.0), HUSKY, "slip")
    for name, replay_hz in (("slip-learning", 7.3), ("gyrodometry", 3.1)):
        assert_equal(tracked_log(), UGV, name, replay_hz=replay_hz)


def edited(run, name, *edits):
    """Return the run with a stream that was edited: in place, or an edit returns which samples are left."""
    stream = run.streams[name]
    time_s, values = np.array(stream.time_s), np.array(stream.values)
    for edit in edits:
        left = edit(time_s, values)
        if left is not None:
            time_s, values = time_s[left], values[left]
    return replace(run, streams={**run.streams, name: Stream(time_s, values, stream.channels)})


def test_live_equals_batch_where_the_robot_is_stuck():
    """The gyro of a robot that stands, on wheels that turn it on the spot."""

    def spins(time_s, values):
        values[(time_s > 8.0) & (time_s < 16.0), :2] = [-0.2, 0.2]

    def stands(time_s, values):
        still = (time_s > 7.9) & (time_s < 16.1)
        values[still, 2] = np.random.default_rng(2).normal(0, 0.01, still.sum())

    run = edited(edited(skid_log(), "wheels", spins), "imu", stands)
    run = replace(run, streams={name: run.streams[name] for name in ("wheels", "imu")})
    estimates = assert_equal(run, HUSKY, "slip")
    times_s = column(estimates, "time_s")[column(estimates, "status") == ObserverStatus.STUCK]
    assert 10.0 <= times_s[0] < 13.0
    assert times_s[-1] == pytest.approx(16.0, abs=0.6)
    assert "stuck" in next(each for each in estimates if each.time_s == times_s[0]).reason


def put(at_s, value, n=30, channel=None):
    """Put a value, or the first one again, in place of ``n`` samples, of one channel or all."""

    def edit(time_s, values):
        start = np.searchsorted(time_s, at_s)
        columns = slice(None) if channel is None else min(channel, values.shape[1] - 1)
        values[start : start + n, columns] = values[start, columns] if value is None else value

    return edit


def gap(at_s, duration_s):
    return lambda time_s, values: (time_s < at_s) | (time_s >= at_s + duration_s)


def stamp(at_s, change, n=1):
    """Stamp ``n`` samples as the one before, or off by a change."""

    def edit(time_s, values):
        at = np.searchsorted(time_s, at_s)
        time_s[at : at + n] = time_s[at - 1] if change is None else time_s[at : at + n] + change

    return edit


def spikes(time_s, values):
    values[np.searchsorted(time_s, np.arange(13.2, 14.0, 0.1))] += 1e4


FAULTS = {
    "values": [
        put(4.0, np.nan),
        put(5.0, np.inf, channel=1),
        gap(6.0, 0.5),
        gap(7.5, 3.0),
        put(11.0, None, n=100),
    ],
    "stamps": [stamp(4.0, None), stamp(6.0, -0.5), stamp(10.0, 1e6), stamp(12.0, np.nan, n=3)],
}
"""Faults of a stream, one after the other: values and gaps, the last of them frozen; stamps twice, back, far ahead
and no numbers."""

SWERVE_STREAMS = ("wheels", "steering", "imu", "odometry")


@pytest.mark.parametrize(
    ("robot", "name", "stream", "kind"),
    [
        *((ROBOT, "vio15", stream, kind) for stream in SWERVE_STREAMS for kind in FAULTS),
        *((HUSKY, "slip", stream, "values") for stream in ("wheels", "imu")),
        *((UGV, "tracked", stream, "values") for stream in ("wheels", "imu", "gnss", "compass")),
    ],
)
def test_faults_cost_live_what_they_cost_the_batch_and_slip_comes_back(robot, name, stream, kind):
    faults = list(FAULTS[kind])
    if name == "vio15" and kind == "values":
        faults.append(spikes)
    elif (
        kind == "stamps" and stream != "wheels"
    ):  # of the wheels live has to take it: a log may have such a gap
        faults.append(stamp(8.0, 0.9))
    estimates = assert_equal(edited(LOGS[robot.name](), stream, *faults), robot, name)
    if name == "vio15":
        assert np.isfinite(column(estimates, "mean")).all()
        late = column(estimates, "time_s") > 14.5
        assert np.nanmean(column(estimates, "slip_ratio")[late]) == pytest.approx(0.125, abs=0.01)


KINDS = [(ROBOT, "vio15"), (HUSKY, "slip"), (UGV, "tracked"), (UGV, "slip-learning")]
ANY_KIND = pytest.mark.parametrize(("robot", "name"), KINDS, ids=[name for _, name in KINDS])


@cache
def steps_of(robot):
    """Return the readings of each step of a robot's log."""
    return [sample.readings for sample in replay(LOGS[robot.name]())]


def shifted(readings, by_s):
    return {name: Reading(reading.time_s + by_s, reading.values) for name, reading in readings.items()}


def wheels_of(robot, time_s):
    return Reading(np.array([time_s]), np.zeros((1, len(channels_of(LOGS[robot.name]())["wheels"]))))


def assert_sound(estimate):
    numbers = np.concatenate([estimate.mean, estimate.std])
    assert not np.isinf(numbers).any()
    assert not np.isinf(estimate.slip_std).any()
    if estimate.health.size:
        assert np.isfinite(numbers).all()
        assert (estimate.std > 0).all()
        assert not (np.abs(estimate.slip_ratio) > 1.0).any()


numbers = st.one_of(
    st.floats(-3.0, 3.0),
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e9, -1e9, 1e300, -1e300, 5e-324]),
)


@st.composite
def garbage(draw, robot):
    """Return readings of a few steps: stamps mostly near their step, values anything."""
    channels, steps = channels_of(LOGS[robot.name]()), []
    for k in range(draw(st.integers(1, 12))):
        readings = {}
        for name in draw(st.sets(st.sampled_from([*channels, "lidar"]), max_size=5)):
            n = draw(st.integers(0, 4))
            width = len(channels.get(name, "ab")) + (draw(st.integers(0, 9)) == 0)
            offsets = st.one_of(st.floats(-0.02, 0.02), numbers)
            stamps = 0.02 * k + np.array(draw(st.lists(offsets, min_size=n, max_size=n)))
            values = np.full((n, width), draw(numbers))
            values.reshape(-1)[::2] = draw(numbers)
            values *= draw(st.sampled_from([1.0, 1.0 + 1e-9, -1.0]))
            readings[name] = Reading(stamps, values)
        steps.append(readings)
    return steps


WRONG = [
    *(None, 0, "wheels", (), (1.0,), {}, (None, None), ("wheels", None), ("a", "b"), (["a"], [["b"] * 6])),
    *((0.0, [[1.0, 1.0]]), ([[0.1]], [[1.0, 1.0]]), ([0.1, 0.2], [[1.0, 1.0]]), ([10**400], [[1.0, 1.0]])),
    *(([1j], [[1.0, 1.0]]), (np.array([object()]), np.array([[1.0, 1.0]]))),
]
"""What is no reading."""


@ANY_KIND
@settings(deadline=None, max_examples=8)
@given(st.data())
def test_arbitrary_and_wrong_readings_neither_raise_nor_make_a_state_infinite(robot, name, data):
    estimator = made(robot, name, **({"initial_yaw_rad": 0.3} if name == "vio15" else {}))
    for nothing in (None, 0, "wheels"):
        assert estimator.step(nothing) == []
    for reading in WRONG:
        assert estimator.step({"wheels": reading, "imu": reading}) == []
    assert all(estimator.dropped[f"{stream}: unreadable"] >= 10 for stream in ("wheels", "imu"))
    for readings in steps_of(robot)[200:260]:
        estimator.step(readings)
    for readings in data.draw(garbage(robot)):
        for estimate in (*estimator.step(shifted(readings, estimator.latest.time_s)), estimator.latest):
            assert_sound(estimate)
    after = settled(estimator, ({"wheels": wheels_of(robot, 1e3 + 0.02 * k)} for k in range(12)))
    assert after[-1].time_s > 1e3  # whatever came before


def test_what_does_not_fit_is_refused():
    left_alone = {"wheels": ("speed_left_mps",)}
    for robot, name, options, message in (
        (ROBOT, "vio15", {"channels": {"wheels": ("current_1_a",)}}, "'motor_1_radps' must be among them"),
        (ROBOT, "vio15", {"initial_yaw_rad": np.nan}, "initial_yaw_rad is nan"),
        (HUSKY, "vio15", {}, "skid_steer"),
        (HUSKY, "slip", {"channels": left_alone}, "'speed_right_mps' must be among them"),
        (UGV, "tracked", {"channels": left_alone}, "'speed_right_mps' must be among them"),
    ):
        with pytest.raises(ConfigError, match=message):
            made(robot, name, **options)


STARTS_S = np.arange(3.0, 15.0, 0.235)
"""Of faults that come again and again: how floats round differs from one to the next."""


LENGTHS = (1, 4, 5, 6, 10)
"""Four samples that jumped, or were lost, are a step of five periods: the low-pass goes on over it; six are not."""


def lost(time_s, values):
    """Leave out samples again and again: gaps of exactly so many periods."""
    kept = np.ones(len(time_s), dtype=bool)
    for start, n in zip(np.searchsorted(time_s, STARTS_S), cycle(LENGTHS), strict=False):
        kept[start + 1 : start + n] = False
    return kept


def jump(time_s, values):
    """Set the speed of so many samples of a camera to another one, again and again."""
    for start, n in zip(np.searchsorted(time_s, STARTS_S), cycle(LENGTHS), strict=False):
        values[start : start + n, 7:10] += 3.0 + 0.001 * np.arange(n)[:, None]


def stamped(rate_hz, stamps):
    """Stamp samples as a logger with six decimals does, or as a sum of periods is rounded."""

    def edit(time_s, values):
        n, offset_s = len(time_s), time_s[0]
        decimal = stamps == "decimal"
        later_s = np.arange(n) / rate_hz if decimal else np.cumsum(np.full(n, 1.0 / rate_hz))
        time_s[:] = np.round(offset_s + later_s, 6) if decimal else offset_s + later_s

    return edit


@pytest.mark.parametrize(
    ("stream", "rate_hz", "stamps", "fault"),
    [
        *(("odometry", 200.0, stamps, jump) for stamps in ("decimal", "summed")),
        *((*stream, "decimal", lost) for stream in (("imu", 100.0), ("odometry", 200.0), ("steering", 50.0))),
    ],
)
def test_a_jump_or_gap_of_any_length_costs_live_what_it_costs_the_batch(stream, rate_hz, stamps, fault):
    assert_equal(edited(log(), stream, stamped(rate_hz, stamps), fault))


@ANY_KIND
def test_samples_that_wait_for_the_wheels_are_bounded(robot, name):
    estimator, n_columns = made(robot, name), len(LOGS[robot.name]().streams["imu"].channels)
    for k in range(40):
        estimator.step({"imu": Reading(k + np.arange(200) / 200.0, np.full((200, n_columns), 0.1))})
    assert estimator.dropped["imu: waited too long"] >= 8000 - QUEUE
    assert len(settled(estimator, [{"wheels": wheels_of(robot, 40.0)}])) == 1


@ANY_KIND
def test_a_clock_that_is_set_back_begins_anew_and_one_stamp_far_ahead_is_left_behind(robot, name):
    steps, expected = steps_of(robot)[:400], None
    for back_s, ahead_s in ((0.0, 0.0), (100.0, 0.0), (0.0, 1e9)):
        estimator, off_s = made(robot, name), [ahead_s * (k == 200) - back_s * (k >= 200) for k in range(400)]
        found = settled(estimator, (shifted(step, off) for step, off in zip(steps, off_s, strict=True)))
        for estimate in found:
            assert_sound(estimate)
        states = column(found[-50:], "mean")[:, 3:5]  # where it is it cannot know
        if expected is None:
            n_ticks, expected = len(found), states
        else:
            assert len(found) >= n_ticks - 10
            assert sum(n for what, n in estimator.dropped.items() if "clock" in what) >= 1
            np.testing.assert_allclose(states, expected, atol=0.05)


# -- samples that come late

OBSERVED_STREAMS = ("wheels", "imu", "gnss", "compass")
PERIOD_S = 0.02
FIRST, N_MIXED, N_AFTER = 60, 25, 15
"""Steps before samples come late, with late ones, and after them."""

MOST_STEPS = 11
"""By so many steps a sample may be late: of 0.25 s, less a step and a period of the wheels."""


@cache
def in_order(robot=ROBOT):
    """Return time and readings of each step; of the IMU a sample that may come late is not finite.

    Fixes are stamped as a tick, but for how they are rounded: one that comes a step later is late, too.
    """
    run = log(duration_s=6.0, seed=5, faults=Faults(by_chance=False)) if robot is ROBOT else tracked_log()
    values = np.array(run.streams["imu"].values)
    values[np.searchsorted(run.streams["imu"].time_s, (FIRST + 5) * PERIOD_S), 3] = np.nan
    imu = Stream(run.streams["imu"].time_s, values, run.streams["imu"].channels)
    names = SWERVE_STREAMS if robot is ROBOT else OBSERVED_STREAMS
    streams = {name: run.streams[name] for name in names} | {"imu": imu}
    for name in set(streams) & {"gnss", "compass"}:
        fixes = streams[name]
        streams[name] = Stream(fixes.time_s + 4e-10, fixes.values, fixes.channels)
    return [(sample.time_s, sample.readings) for sample in replay(replace(run, streams=streams))]


def drive(steps, now=False, robot=ROBOT, name="vio15"):
    """Return an estimator that was given readings step by step, and the time of each where `now` says so."""
    estimator = made(robot, name)
    for time_s, readings in steps:
        estimator.step(readings, time_s if now else None)
    return estimator


@cache
def undelayed(now=False, robot=ROBOT, name="vio15"):
    return drive(in_order(robot)[: FIRST + N_MIXED + N_AFTER], now, robot, name)


def delayed(delays_of, robot=ROBOT):
    """Return steps whose readings come later, by stream a number of steps for each of the mixed ones.

    What is late of the wheels keeps its order: the next sample comes no earlier.
    """
    steps, wheels_at = in_order(robot)[: FIRST + N_MIXED + N_AFTER], 0
    arrivals = [defaultdict(list) for _ in steps]
    for k, (_, readings) in enumerate(steps):
        for name, reading in readings.items():
            is_mixed = name in delays_of and 0 <= k - FIRST < N_MIXED
            at = k + delays_of[name][k - FIRST] if is_mixed else k
            if name == "wheels":
                at = wheels_at = max(at, wheels_at)
            arrivals[at][name].append(reading)
    for came in arrivals:
        for name, readings in came.items():
            came[name] = Reading(*map(np.concatenate, zip(*readings, strict=True)))
    return [(time_s, came) for (time_s, _), came in zip(steps, arrivals, strict=True)]


def assert_same(estimator, expected):
    for one, other in zip(estimator.latest, expected.latest, strict=True):
        np.testing.assert_array_equal(one, other)
    assert estimator.health == expected.health
    found, desired = (counted(one.dropped, "came late|ticks without wheels") for one in (estimator, expected))
    assert found == desired
    if estimator.filter is not None:
        for one, other in zip(estimator._snapshot(), expected._snapshot(), strict=True):
            assert repr(one) == repr(other)  # to the last bit, and NaN as NaN
            assert [part.tobytes() for part in one if isinstance(part, np.ndarray)] == [
                part.tobytes() for part in other if isinstance(part, np.ndarray)
            ]


delays = st.lists(st.integers(0, MOST_STEPS), min_size=N_MIXED, max_size=N_MIXED)


@settings(deadline=None, max_examples=25)
@given(st.dictionaries(st.sampled_from(SWERVE_STREAMS), delays, min_size=1), st.booleans())
def test_late_samples_give_the_numbers_of_samples_in_time(delays_of, now):
    """Ticks without wheels, which were done for want of them, leave nothing behind."""
    assert_same(drive(delayed(delays_of), now), undelayed(now))


def test_late_samples_do_not_count_the_time_outside_of_a_region_twice():
    """It is less than what is warned of, but more where each rewind counts its ticks again."""
    robot, late = replace(ROBOT, region=Region((-0.1, 0.1), None, None, ())), {"imu": [3, 4] * N_MIXED}
    in_time, rewound = (drive(delayed(each), robot=robot).model for each in ({}, late))
    assert 0.3 < in_time._region.memory[0] < OUTSIDE_S
    assert rewound._region.memory == in_time._region.memory


def test_what_the_gate_of_an_observer_left_out_is_counted():
    run = edited(skid_log(), "imu", put(8.0, 2.0, channel=2))
    estimator = made(HUSKY, "slip", channels_of(run))
    settled(estimator, (sample.readings for sample in replay(run)))
    assert 5 <= estimator.dropped["gyro gated"] <= 30


def turned(at_s, by_rad):
    def edit(time_s, values):
        values[time_s >= at_s, 8] += by_rad

    return edit


@pytest.mark.parametrize(
    ("stream", "edit", "status", "from_s", "to_s"),
    [
        ("odometry", gap(-1.0, 3.0), ObserverStatus.STARTING, 0.0, 1.9),
        ("odometry", gap(-1.0, 0.0), ObserverStatus.STANDING, 0.5, 0.9),
        ("odometry", gap(-1.0, 0.0), ObserverStatus.OK, 6.0, 8.0),
        ("odometry", gap(8.0, 2.0), ObserverStatus.PREDICTED, 8.2, 9.9),
        ("wheels", put(8.0, np.nan, 50), ObserverStatus.BAD_INPUT, 8.0, 8.9),
        ("imu", turned(8.0, 0.5), ObserverStatus.REJECTED, 8.38, 8.5),
        ("imu", turned(8.0, 0.5), ObserverStatus.RESET, 8.5, 8.7),
    ],
)
def test_a_swerve_robot_says_what_its_estimates_are_worth(stream, edit, status, from_s, to_s):
    run = edited(log(), stream, edit)
    estimates = settled(made(), (sample.readings for sample in replay(run)))
    found = [one.status for one in estimates if from_s <= one.time_s < to_s]
    assert status in found if status is ObserverStatus.RESET else set(found) == {status}


@pytest.mark.parametrize("name", ["tracked", "slip-learning", "gyrodometry"])
@settings(deadline=None, max_examples=4)
@given(st.dictionaries(st.sampled_from(OBSERVED_STREAMS[1:]), delays, min_size=1))
def test_an_observer_takes_late_samples_as_those_in_time(name, delays_of):
    assert_same(drive(delayed(delays_of, UGV), False, UGV, name), undelayed(False, UGV, name))


@pytest.mark.parametrize("name", SWERVE_STREAMS)
def test_what_comes_later_than_the_reach_is_counted_and_changes_nothing(name):
    """Three readings that come 0.3 s late, or never."""
    n_late, steps = int(REWIND_S / PERIOD_S) + 3, in_order()[: FIRST + N_MIXED + N_AFTER]
    without = [
        (time_s, {other: r for other, r in readings.items() if other != name or not 0 <= k - FIRST < 3})
        for k, (time_s, readings) in enumerate(steps)
    ]
    never, late, n_samples = drive(without), drive(()), 0
    for k, (_, readings) in enumerate(without):
        if 0 <= k - n_late - FIRST < 3:
            before, too_late = late.latest, steps[k - n_late][1][name]
            assert late.step({name: too_late}) == []
            assert late.latest is before
            n_samples += too_late.time_s.size
        late.step(readings)
    kind = "time did not advance" if name == "wheels" else f"{name}: stamp does not increase"
    assert late.dropped[kind] - never.dropped.get(kind, 0) == n_samples >= 3
    for one, other in zip(late.latest, never.latest, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_wheels_ticks_go_on_by_the_callers_time_and_uncertainty_grows():
    estimator, times_s, stds = drive(()), [], []
    for time_s, readings in in_order():
        estimator.step({n: r for n, r in readings.items() if n != "wheels" or time_s <= 2.0}, time_s)
        if estimator.latest is not None:
            times_s.append(estimator.latest.time_s)
            stds.append(estimator.latest.std[estimator.states.index("slip_speed_1_mps")])
    times_s, stds = np.array(times_s), np.array(stds)
    gone = times_s > 2.03
    assert np.diff(times_s[gone]).max() < 2.1 * PERIOD_S
    assert in_order()[-1][0] - times_s[-1] < 2.0 * PERIOD_S
    assert estimator.dropped["ticks without wheels"] == len(set(times_s[gone]))
    assert stds[-1] > 2.0 * stds[~gone][-1]
    assert np.isnan(estimator.latest.motor_radps).all()


def test_a_stamp_far_ahead_does_not_end_the_wait_for_its_stream():
    """The IMU's stamps are an hour ahead once; later, its samples come three steps after the wheels'."""
    (estimator, found), (expected, in_time) = (drive(()), []), (drive(()), [])
    late = delayed({"imu": [3] * N_MIXED})
    for k, ((_, readings), (_, others)) in enumerate(zip(late, in_order(), strict=False)):
        if k == FIRST - 10:
            imu = Reading(readings["imu"].time_s + 3600.0, readings["imu"].values)
            readings, others = {**readings, "imu": imu}, {n: r for n, r in others.items() if n != "imu"}
        found += estimator.step(readings)
        in_time += expected.step(others)
    means = {estimate.time_s: estimate.mean for estimate in in_time}
    assert len(found) > FIRST + N_MIXED - 5
    assert (np.diff([estimate.time_s for estimate in found]) > 0.0).all()
    for estimate in found[: FIRST + N_MIXED - 5]:  # after that the last late ones come out of order
        np.testing.assert_array_equal(estimate.mean, means[estimate.time_s])
