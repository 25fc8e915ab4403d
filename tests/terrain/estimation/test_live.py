"""Live estimation: the batch's numbers where the batch does not look ahead, and sense whatever comes."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrain.errors import ConfigError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.feed import GNSS_ROWS, ROWS, ROWS_OF_DRIVE, measurement_table
from terrain.estimation.filter import GATE_PROBABILITY, REOPEN_AFTER_S, FilterSettings, Noise, run_filter
from terrain.estimation.live import CHANNELS, QUEUE, LiveFilter
from terrain.estimation.models.skid import Motion, stuck_intervals
from terrain.estimation.models.swerve import default_noise, make_filter, scheduled
from terrain.estimation.wheel_slip import wheel_slip
from terrain.kinematics.camera import CHANNELS as CAMERA_CHANNELS
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs.replay import replay
from terrain.records import Reading, Stream
from terrain.robots import load_robot
from terrain.simulation.conditions import Faults
from terrain.simulation.run import simulate_run
from terrain.simulation.sensors import Gnss

ROBOT = load_robot("agrimaro")
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
HUSKY, SIDES = load_robot("husky"), ("speed_left_mps", "speed_right_mps")
IDEAL = ROBOT.with_parts(sensors=replace(ROBOT.sensors, encoder_time_constant_s=0.0))
MIDDLE_S = 8.0


@cache
def log(scenario="straight", duration_s=16.0, gnss=False, lost=(), seed=3):
    return simulate_run(
        ROBOT,
        "grass",
        scenario,
        seed,
        duration_s=duration_s,
        faults=Faults(camera_lost_s=lost),
        gnss=Gnss() if gnss else None,
    )


def live(run, robot=ROBOT, name="vio15", yaw=None, rate_hz=50.0):
    channels = {stream: run.streams[stream].channels for stream in CHANNELS if stream in run.streams}
    estimator = LiveFilter(robot, name, channels, initial_yaw_rad=yaw)
    return estimator, settled(estimator, (sample.readings for sample in replay(run, rate_hz)))


def settled(estimator, steps):
    """Return the estimates of steps, to the last one."""
    estimates = [estimate for readings in steps for estimate in estimator.step(readings)]
    return estimates + estimator.settle(all_of_them=True)


def column(estimates, name):
    return np.array([getattr(estimate, name) for estimate in estimates], dtype=float)


def batch(run, robot=ROBOT, name="vio15", yaw=None):
    table = measurement_table(run, robot, causal=True, initial_yaw_rad=yaw or 0.0)
    model, noise = make_filter(name, robot, yaw is not None), default_noise(name, robot, yaw is not None)
    if yaw is not None:
        variance = np.tile(noise.measurement_variance, (table.time_s.size, 1))
        variance[:, [model.rows.index(row) for row in GNSS_ROWS]] = table.gnss_variance
        noise = Noise(noise.process_variance, variance, noise.initial_variance)
    desired = FilterSettings(GATE_PROBABILITY, REOPEN_AFTER_S)
    noise, inputs = scheduled(model, noise, table)
    track = run_filter(model, noise, table.time_s, table.columns(model.rows), desired, inputs)
    return table.at(track.time_s), track, wheel_slip(track, table.at(track.time_s), robot)


def assert_equal(run, robot=ROBOT, name="vio15", yaw=None):
    """Compare everything at every tick; return the live side."""
    estimator, estimates = live(run, robot, name, yaw)
    table, track, slip = batch(run, robot, name, yaw)
    np.testing.assert_array_equal(column(estimates, "time_s"), table.time_s)
    rows = [row not in GNSS_ROWS or yaw is not None for row in ROWS_OF_DRIVE["swerve"]]
    np.testing.assert_allclose(
        column(estimates, "rows")[:, : len(rows)][:, rows], table.z[:, rows], rtol=0, atol=1e-12
    )
    std = np.column_stack([track.std(state) for state in track.states])
    for what, desired in {
        "mean": track.mean,
        "std": std,
        "slip_ratio": slip.slip_ratio,
        "slip_std": slip.slip_std,
        "slip_stale": slip.stale,
        "reference_age_s": track.reference_age_s,
        "speed_x_mps": track.state("speed_x_mps"),
        "accel_y_mps2": track.state("accel_y_mps2"),
    }.items():
        np.testing.assert_allclose(column(estimates, what), desired, rtol=0, atol=1e-9, err_msg=what)
    counted = {kind: n for kind, n in estimator.dropped.items() if "clock" not in kind and "time" not in kind}
    batch_counts = {**table.dropped, **track.dropped}
    batch_counts.pop("wheels: stamp does not increase", None)
    batch_counts.pop("clock jump", None)
    assert counted == batch_counts
    return estimates


@pytest.mark.parametrize(
    ("scenario", "duration_s", "robot", "name", "yaw"),
    [
        ("straight", 16.0, ROBOT, "vio15", None),
        ("survey", 40.0, ROBOT, "vio15", None),
        ("complex", 40.0, ROBOT, "vio15", None),
        ("complex", 30.0, ODD, "vio15", None),
        ("complex", 30.0, IDEAL, "vio15", None),
        ("complex", 30.0, ROBOT, "vio15", 0.0),
        ("complex", 30.0, ROBOT, "vio12", None),
        ("complex", 30.0, ROBOT, "slip14", None),
        ("straight", 16.0, ROBOT, "encoder12", 0.1),
    ],
)
def test_live_equals_batch(scenario, duration_s, robot, name, yaw):
    run = log(scenario, duration_s, gnss=yaw is not None)
    estimates = assert_equal(run, robot, name, yaw)
    wheels = with_wheel_speeds(run, robot).streams["wheels"]
    for what, pattern in (("wheel_speed_mps", "speed_{}_mps"), ("current_a", "current_{}_a")):
        raw = np.column_stack([wheels.channel(pattern.format(i)) for i in (1, 2, 3)])
        np.testing.assert_array_equal(column(estimates, what), raw)


def edited(run, name, edit):
    stream = run.streams[name]
    time_s, values = edit(np.array(stream.time_s), np.array(stream.values))
    return replace(run, streams={**run.streams, name: Stream(time_s, values, stream.channels)})


def put(value, n=30, channel=slice(None)):
    def edit(time_s, values):
        start = np.searchsorted(time_s, MIDDLE_S)
        values[start : start + n, channel] = values[start, channel] if value is None else value
        return time_s, values

    return edit


def gap(duration_s):
    def edit(time_s, values):
        kept = (time_s < MIDDLE_S) | (time_s >= MIDDLE_S + duration_s)
        return time_s[kept], values[kept]

    return edit


def stamp(change, n=1):
    def edit(time_s, values):
        at = np.searchsorted(time_s, MIDDLE_S)
        time_s[at : at + n] = time_s[at - 1] if change is None else time_s[at : at + n] + change
        return time_s, values

    return edit


def spikes(time_s, values):
    values[200::97] += 1e4
    return time_s, values


FAULTS = {
    "NaN": put(np.nan),
    "spikes": spikes,
    "infinite": put(np.inf, channel=2),
    "gap of 0.5 s": gap(0.5),
    "gap of 3 s": gap(3.0),
    "frozen": put(None, n=100),
    "a stamp twice": stamp(None),
    "a stamp back": stamp(-0.5),
    "a stamp ahead": stamp(0.9),
    "a stamp far ahead": stamp(1e6),
    "stamps that are no numbers": stamp(np.nan, n=3),
}


@pytest.mark.parametrize(
    ("stream", "fault"),
    [
        (stream, fault)
        for stream in ("wheels", "steering", "imu", "odometry")
        for fault in FAULTS
        if (stream, fault) != ("wheels", "a stamp ahead")  # a gap that a log may have: live has to take it
    ],
)
def test_faults_cost_live_what_they_cost_the_batch_and_slip_comes_back(stream, fault):
    estimates = assert_equal(edited(log(), stream, FAULTS[fault]))
    assert np.isfinite(column(estimates, "mean")).all()
    late = column(estimates, "time_s") > MIDDLE_S + 5.0
    assert np.nanmean(column(estimates, "slip_ratio")[late]) == pytest.approx(0.125, abs=0.01)


def spinning(time_s, values):
    values[(time_s > 8.0) & (time_s < 16.0), :2] = [-0.2, 0.2]
    return time_s, values


def standing(time_s, values):
    still = (time_s > 7.9) & (time_s < 16.1)
    values[still, 2] = np.random.default_rng(2).normal(0, 0.01, still.sum())
    return time_s, values


@pytest.mark.parametrize(
    ("scenario", "soil", "seed", "stuck"),
    [
        *(("survey", "grass", 31, False), ("complex", "tilled_loam", 32, False)),
        *(("straight", "snow", 33, False), ("survey", "grass", 31, True)),
    ],
)
def test_live_equals_batch_of_a_skid_steer_robot_to_the_last_bit(scenario, soil, seed, stuck):
    """Where it is stuck, its gyro stands still, on wheels that turn it on the spot."""
    run = simulate_run(HUSKY, soil, scenario, seed, duration_s=30.0)
    if stuck:
        run = edited(edited(run, "wheels", spinning), "imu", standing)
    channels = {name: run.streams[name].channels for name in ("wheels", "imu")}
    estimates = settled(LiveFilter(HUSKY, "skid", channels), (each.readings for each in replay(run, 50.0)))
    found = estimate_run(run, HUSKY, "skid")
    track, rows, since_s = found.track, column(estimates, "rows"), column(estimates, "stuck_since_s")
    for what, desired in {
        "time_s": track.time_s,
        "mean": track.mean,
        "std": np.column_stack([track.std(state) for state in track.states]),
        "yaw_rate_radps": track.state("yaw_rate_radps"),
        "speed_x_mps": track.state("speed_mps"),
        "motion": found.motion,
    }.items():
        np.testing.assert_array_equal(column(estimates, what), desired, err_msg=what)
    places = [ROWS.index(row) for row in found.model.rows]
    np.testing.assert_array_equal(rows[:, places], found.table.columns(found.model.rows))
    np.testing.assert_array_equal(np.isfinite(since_s), found.motion == Motion.STUCK)
    intervals = stuck_intervals(track.time_s, found.motion)
    assert set(since_s[np.isfinite(since_s)].tolist()) == {interval.start_s for interval in intervals}
    if stuck:
        assert 8.0 <= intervals[0].start_s < 11.0
        assert intervals[0].end_s == pytest.approx(16.0, abs=0.6)


def test_a_clock_that_is_set_back_is_believed_when_the_next_stamp_follows():
    run = log()
    estimator, estimates = LiveFilter(ROBOT), []
    for sample in replay(run):
        back_s = 100.0 * (sample.time_s < MIDDLE_S)
        readings = {
            name: Reading(reading.time_s + back_s, reading.values)
            for name, reading in sample.readings.items()
        }
        estimates += estimator.step(readings)
    estimates += estimator.settle(all_of_them=True)
    assert len(estimates) == len(run.streams["wheels"]) - 1
    assert estimator.dropped["clock jump"] == 1
    _, plain = live(run)
    known = {round(estimate.time_s, 6): estimate for estimate in plain}
    for estimate in estimates[-100:]:
        desired = known[round(estimate.time_s, 6)]
        assert not estimate.slip_stale
        np.testing.assert_allclose(estimate.slip_ratio, desired.slip_ratio, atol=0.01)


def test_the_queue_of_samples_ahead_of_the_wheels_is_bounded():
    estimator = LiveFilter(ROBOT)
    rng = np.random.default_rng(0)
    for k in range(40):
        time_s = k + np.arange(200) / 200.0
        estimator.step({"odometry": Reading(time_s, rng.standard_normal((200, len(CAMERA_CHANNELS))))})
    assert estimator.dropped["odometry: waited too long"] >= 8000 - QUEUE
    wheels = Reading(np.array([40.0]), np.zeros((1, 6)))
    assert len(settled(estimator, [{"wheels": wheels}])) == 1


numbers = st.one_of(
    st.floats(-3.0, 3.0), st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e9, -1e9, 1e300, -1e300, 5e-324])
)


WRONG = [
    *(None, 0, "wheels", (), (1.0,), {}, (None, None), ("wheels", None), ("a", "b"), (["a"], [["b"] * 6])),
    *((0.0, [[1.0, 1.0]]), ([[0.1]], [[1.0, 1.0]]), ([0.1, 0.2], [[1.0, 1.0]]), ([10**400], [[1.0, 1.0]])),
    *(([1j], [[1.0, 1.0]]), (np.array([object()]), np.array([[1.0, 1.0]]))),
]
"""What is no reading."""


@st.composite
def garbage(draw, widths):
    """Return readings of a few steps by what is added to a stamp: near their step, values anything; or none."""
    steps = []
    for k in range(draw(st.integers(1, 12))):
        readings = {}
        for name in draw(st.sets(st.sampled_from([*widths, "lidar"]), max_size=5)):
            if draw(st.integers(0, 5)) == 0:
                readings[name] = draw(st.sampled_from(WRONG))
                continue
            n = draw(st.integers(0, 4))
            width = widths.get(name, 2) + (draw(st.integers(0, 9)) == 0)
            offsets = st.one_of(st.floats(-0.02, 0.02), numbers)
            stamps = 2.0 + 0.02 * k + np.array(draw(st.lists(offsets, min_size=n, max_size=n)))
            values = np.full((n, width), draw(numbers))
            values.reshape(-1)[::2] = draw(numbers)
            values *= draw(st.sampled_from([1.0, 1.0 + 1e-9, -1.0]))
            readings[name] = Reading(stamps, values)
        steps.append(readings)
    return steps


@settings(deadline=None, max_examples=80)
@given(st.data(), st.sampled_from([("vio15", None), ("vio15", 0.3), ("skid", None)]))
def test_arbitrary_readings_neither_raise_nor_make_a_state_infinite(data, kind):
    name, yaw = kind
    widths = {"wheels": 2, "imu": 9} if name == "skid" else {each: len(c) for each, c in CHANNELS.items()}
    estimator = LiveFilter(HUSKY if name == "skid" else ROBOT, name, initial_yaw_rad=yaw)
    estimator.step({"wheels": ("wheels", None)})
    assert estimator.dropped["wheels: unreadable"] == 1
    sound = [
        {"wheels": _wheels(0.02 * k, 2), "imu": Reading(np.array([0.02 * k]), np.zeros((1, 9)))}
        for k in range(60)
    ]
    for readings in sound if name == "skid" else (sample.readings for sample in list(replay(log()))[40:101]):
        estimator.step(readings)
    for readings in data.draw(garbage(widths)):
        for estimate in (*estimator.step(readings), estimator.latest):
            assert np.isfinite(estimate.mean).all()
            assert (np.isfinite(estimate.std) & (estimate.std > 0)).all()
            assert not (np.abs(estimate.slip_ratio) > 1.0).any()
            assert not np.isinf(estimate.slip_std).any()
    after = settled(estimator, ({"wheels": _wheels(1e3 + 0.02 * k, widths["wheels"])} for k in range(3)))
    assert after[-1].time_s > 1e3  # it goes on whatever came before


def _wheels(time_s, width):
    return Reading(np.array([time_s]), np.zeros((1, width)))


def test_columns_go_by_name():
    run = log()
    order = {name: list(reversed(run.streams[name].channels)) for name in CHANNELS if name in run.streams}
    turned = replace(
        run,
        streams={
            name: Stream(s.time_s, s.values[:, ::-1], order[name]) if name in order else s
            for name, s in run.streams.items()
        },
    )
    _, plain = live(run)
    _, other = live(turned)
    np.testing.assert_array_equal(column(other, "slip_ratio"), column(plain, "slip_ratio"))
    few = LiveFilter(ROBOT, channels={"wheels": CHANNELS["wheels"][:3]})
    (estimate,) = few.step({"wheels": Reading(np.array([0.0]), np.ones((1, 3)))})
    assert np.isnan(estimate.current_a).all()


@pytest.mark.parametrize(
    ("robot", "name", "options", "message"),
    [
        (ROBOT, "vio15", {"channels": {"wheels": ("current_1_a",)}}, "'motor_1_radps' must be among them"),
        (ROBOT, "vio15", {"gnss_latency_s": -1.0}, "gnss_latency_s is -1"),
        (ROBOT, "vio15", {"initial_yaw_rad": np.nan}, "initial_yaw_rad is nan"),
        (HUSKY, "vio15", {}, "skid_steer"),
        (ROBOT, "skid", {}, "robot agrimaro has the drive 'swerve': this filter is for 'skid_steer'"),
        (HUSKY, "skid", {"channels": {"wheels": SIDES[:1]}}, "'speed_right_mps' must be among them"),
        (
            HUSKY,
            "skid",
            {"channels": {"wheels": SIDES, "imu": ("roll_rad",)}},
            "'gyro_z_radps' must be among",
        ),
        (
            HUSKY,
            "skid",
            {"rate_hz": {"imu": 0.0}},
            "rate of 'imu' is 0.0 Hz, a number above zero is required",
        ),
        (HUSKY, "skid", {"rate_hz": {"wheels": np.nan}}, "rate of 'wheels' is nan Hz"),
    ],
)
def test_invalid_options_are_refused(robot, name, options, message):
    with pytest.raises(ConfigError, match=message):
        LiveFilter(robot, name, **options)


STARTS_S = np.arange(3.0, 15.0, 0.235)
"""Of faults that come again and again: how floats round differs from one to the next."""


def lost(n):
    """Leave out samples again and again: gaps of exactly ``n`` periods."""

    def edit(time_s, values):
        kept = np.ones(len(time_s), dtype=bool)
        for start in np.searchsorted(time_s, STARTS_S):
            kept[start + 1 : start + n] = False
        return time_s[kept], values[kept]

    return edit


def jump(n):
    """Set the speed of ``n`` samples of a camera to another one, again and again."""

    def edit(time_s, values):
        for start in np.searchsorted(time_s, STARTS_S):
            values[start : start + n, 7:10] += 3.0 + 0.001 * np.arange(n)[:, None]
        return time_s, values

    return edit


def stamped(rate_hz, stamps):
    """Stamp samples as a logger with six decimals does, or as a sum of periods is rounded."""

    def edit(time_s, values):
        n, offset_s = len(time_s), time_s[0]
        if stamps == "decimal":
            return np.round(offset_s + np.arange(n) / rate_hz, 6), values
        return offset_s + np.cumsum(np.full(n, 1.0 / rate_hz)), values

    return edit


@pytest.mark.parametrize("stamps", ["decimal", "summed"])
@pytest.mark.parametrize(
    "n", [1, 4, 10, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 3, 5, 6, 7, 8, 9))]
)
def test_a_jump_of_any_length_costs_live_what_it_costs_the_batch(n, stamps):
    """Four samples that jumped are a step of five periods: the low-pass goes on over it, live and in batch."""
    run = edited(edited(log(), "odometry", stamped(200.0, stamps)), "odometry", jump(n))
    assert_equal(run)


@pytest.mark.parametrize("stream", ["imu", "odometry", "steering"])
@pytest.mark.parametrize(
    "n", [2, 5, 10, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 4, 6, 7, 8, 9))]
)
def test_a_gap_of_whole_periods_costs_live_what_it_costs_the_batch(n, stream):
    rate_hz = {"imu": 100.0, "odometry": 200.0, "steering": 50.0}[stream]
    assert_equal(edited(edited(log(), stream, stamped(rate_hz, "decimal")), stream, lost(n)))
