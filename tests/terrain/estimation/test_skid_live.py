"""Live estimation of a skid-steer robot: the batch's numbers to the last bit, and sense whatever comes."""

from functools import cache

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.feed import ROWS
from terrain.estimation.live import LiveFilter
from terrain.estimation.models.skid import Motion, stuck_intervals
from terrain.logs.replay import replay
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

HUSKY = load_robot("husky")


@cache
def log(scenario="survey", seed=31, soil="grass", duration_s=30.0):
    return simulate_run(HUSKY, soil, scenario, seed, duration_s=duration_s)


def live(run, replay_hz=50.0, **options):
    channels = {name: run.streams[name].channels for name in ("wheels", "imu") if name in run.streams}
    estimator = LiveFilter(HUSKY, "skid", channels, **options)
    estimates = [e for sample in replay(run, replay_hz) for e in estimator.step(sample.readings)]
    return estimator, estimates + estimator.settle(all_of_them=True)


def column(estimates, name):
    return np.array([getattr(estimate, name) for estimate in estimates], dtype=float)


def assert_equal(run, **options):
    """Compare everything at every tick, to the last bit; return both sides."""
    estimator, estimates = live(run, **options)
    found = estimate_run(run, HUSKY, "skid")
    track = found.track
    np.testing.assert_array_equal(column(estimates, "time_s"), track.time_s)
    rows = column(estimates, "rows")[:, [ROWS.index(row) for row in found.model.rows]]
    np.testing.assert_array_equal(rows, found.table.columns(found.model.rows))
    np.testing.assert_array_equal(column(estimates, "mean"), track.mean)
    std = np.column_stack([track.std(state) for state in track.states])
    np.testing.assert_array_equal(column(estimates, "std"), std)
    np.testing.assert_array_equal(column(estimates, "yaw_rate_radps"), track.state("yaw_rate_radps"))
    np.testing.assert_array_equal(column(estimates, "speed_x_mps"), track.state("speed_mps"))
    np.testing.assert_array_equal(column(estimates, "motion"), found.motion)
    starts = {interval.start_s for interval in stuck_intervals(track.time_s, found.motion)}
    since_s = column(estimates, "stuck_since_s")
    np.testing.assert_array_equal(np.isfinite(since_s), found.motion == Motion.STUCK)
    assert set(since_s[np.isfinite(since_s)].tolist()) == starts
    return estimator, found


@pytest.mark.parametrize(
    ("scenario", "soil", "seed"),
    [("survey", "grass", 31), ("complex", "tilled_loam", 32), ("straight", "snow", 33)],
)
def test_live_equals_batch(scenario, soil, seed):
    assert_equal(log(scenario, seed, soil))


def test_live_equals_batch_where_the_robot_is_stuck():
    """The gyro of a robot that stands, on wheels that turn it on the spot."""
    run = log()
    wheels, imu = run.streams["wheels"], run.streams["imu"]
    spins = (wheels.time_s > 8.0) & (wheels.time_s < 16.0)
    sides = [wheels.channels.index(f"speed_{side}_mps") for side in ("left", "right")]
    values, angular = np.array(wheels.values), np.array(imu.values)
    values[np.ix_(spins, sides)] = [-0.2, 0.2]
    still = (imu.time_s > 7.9) & (imu.time_s < 16.1)
    angular[still, imu.channels.index("gyro_z_radps")] = np.random.default_rng(2).normal(0, 0.01, still.sum())
    spinning = type(run)(
        run.run_id,
        run.robot,
        {
            "wheels": Stream(wheels.time_s, values, wheels.channels),
            "imu": Stream(imu.time_s, angular, imu.channels),
        },
    )
    _, found = assert_equal(spinning)
    (interval,) = stuck_intervals(found.track.time_s, found.motion)
    assert 8.0 <= interval.start_s < 11.0
    assert interval.end_s == pytest.approx(16.0, abs=0.6)


@pytest.mark.parametrize(
    ("robot", "options", "message"),
    [
        ("agrimaro", {}, "robot agrimaro has the drive 'swerve': this filter is for 'skid_steer'"),
        ("husky", {"channels": {"wheels": ("speed_left_mps",)}}, "'speed_right_mps' must be among them"),
        (
            "husky",
            {"channels": {"wheels": ("speed_left_mps", "speed_right_mps"), "imu": ("accel_x_mps2",)}},
            "'gyro_z_radps' must be among them",
        ),
        ("husky", {"rate_hz": {"imu": 0.0}}, "rate of 'imu' is 0.0 Hz, a number above zero is required"),
        ("husky", {"rate_hz": {"wheels": np.nan}}, "rate of 'wheels' is nan Hz"),
    ],
)
def test_what_does_not_fit_is_refused(robot, options, message):
    with pytest.raises(ConfigError, match=message):
        LiveFilter(load_robot(robot), "skid", **options)
