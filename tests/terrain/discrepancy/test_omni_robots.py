"""Omni robots: what makes them slip is named from their wheels, currents and a camera above."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy.diagnose import diagnose
from terrain.discrepancy.runs import Simulation, signals_of
from terrain.effects import CHANNELS, CURRENT, HEADING, SPEED_X, SPEED_Y, showing
from terrain.errors import DataError
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.logs import robotino
from terrain.records import Stream
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate

pytestmark = pytest.mark.usefixtures("without_next_drive")
ROBOT = load_robot("robotino")
CARPET = Ground(slip_ratio=0.8, rolling_ratio=0.03, roller_ratio=0.3)
FREE = CARPET._replace(roller_ratio=0.0, rolling_ratio=0.0)
"""What resists turns the robot, which no scale of a camera does."""


def driven(hidden, ground=CARPET, n=12, turns=True, seed=0):
    """Return runs in as many directions, at changing speed, turning now and then."""
    rng, runs = np.random.default_rng(seed), []
    for i in range(n):
        angle, twist = 2 * np.pi * (i + 0.5) / n, np.zeros((601, 3))
        for k in range(25, 575, 110):
            speed = rng.uniform(0.15, 0.45)
            turn = turns * rng.choice([-1.0, 0.0, 1.0]) * rng.uniform(0.3, 0.9)
            twist[k : k + 110] = speed * np.cos(angle), speed * np.sin(angle), turn
        ramp = np.cumsum(np.clip(np.diff(twist, axis=0, prepend=0.0), -9.0, 9.0), axis=0)
        about = {"run_id": f"carpet_{i:02d}", "terrain": "carpet", "noise": spread_numbers("noise")}
        run = simulate(ROBOT, ramp, ground, 1000 * seed + i, effects=hidden, **about)
        runs.append(with_wheel_speeds(run, ROBOT))
    return runs


def with_streams(run, **changed):
    return replace(run, streams=run.streams | changed)


def without_channels(run, prefix):
    """Return a run whose wheels have no channels of a kind."""
    wheels = run.streams["wheels"]
    left = [i for i, name in enumerate(wheels.channels) if not name.startswith(prefix)]
    names = [wheels.channels[i] for i in left]
    return with_streams(run, wheels=Stream(wheels.time_s, wheels.values[:, left], names))


def diagnosed(runs, ground=CARPET):
    return diagnose(runs, Simulation(ROBOT, ground, scatter=spread_numbers("scatter")))


def values_of(diagnosis):
    return {value.name: value for cause in diagnosis.causes for value in cause.parameters}


FRICTION, SCALE = {"roller_friction_ratio": 0.1}, {"camera_scale_ratio": -0.08}
SLOW = (
    {},
    {"load_shift_x_m": 0.012, "load_shift_y_m": -0.006},
    {"wheel_distance_ratio": 0.06},
    {"force_slip_ratio": 0.4},
    {"lever_x_m": 0.05, "lever_y_m": 0.02},
    {"rolling_resistance_ratio": 0.04},
    {"viscous_drag_nspm": 20.0},
)


@pytest.mark.parametrize(
    "hidden",
    [FRICTION | SCALE, *(pytest.param(values, marks=pytest.mark.slow) for values in SLOW)],
    ids=lambda hidden: next(iter(hidden), "nothing"),
)
def test_what_is_hidden_is_named_with_its_value_and_nothing_beside_it(hidden):
    diagnosis = diagnosed(driven(hidden))
    values = values_of(diagnosis)
    assert set(values) == set(hidden), (diagnosis.verdict, diagnosis.ambiguous_sets)
    assert (diagnosis.ambiguous_sets, diagnosis.excluded_runs, diagnosis.faults) == ((), (), ())
    for name, size in hidden.items():
        assert values[name].low - 0.1 * abs(size) < size < values[name].high + 0.1 * abs(size), name


def test_scale_of_a_camera_and_radius_of_the_wheels_are_one_on_straight_drives():
    """Only the torque of a larger wheel parts them."""
    diagnosis = diagnosed(driven(SCALE, FREE, turns=False, seed=3), FREE)
    assert [set(names) for names in diagnosis.ambiguous_sets] == [{"camera_scale", "wheel_radius"}]
    assert diagnosis.causes == ()


@pytest.fixture(scope="module")
def one():
    return driven({}, n=1)[0]


def measured_of(run, *names):
    return signals_of(run, ROBOT).measured[:, [CHANNELS.index(name) for name in names]].T


def test_signals_are_those_of_the_pose_and_the_sum_of_the_magnitudes_of_the_currents(one):
    truth, wheels, time_s = one.streams["truth"], one.streams["wheels"], signals_of(one, ROBOT).time_s
    *motion, current = measured_of(one, SPEED_X, SPEED_Y, HEADING, CURRENT)
    for values, true, std in zip(
        motion, ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"), (0.04, 0.04, 0.4), strict=True
    ):
        off = values - np.interp(time_s, truth.time_s, truth.channel(true))
        assert np.isfinite(off).mean() > 0.95
        assert np.sqrt(np.nanmean(off**2)) < std
        assert abs(np.nanmean(off)) < 0.1 * std
    total = sum(np.abs(wheels.channel(f"current_{i}_a")) for i in (1, 2, 3))
    np.testing.assert_allclose(current, np.interp(time_s, wheels.time_s, total), atol=1e-9)


def test_a_camera_leaves_holes_where_it_loses_the_robot_and_its_jumps_are_no_speed(one):
    pose, time_s = one.streams["pose"], signals_of(one, ROBOT).time_s
    seen = (pose.time_s < 4.0) | (pose.time_s > 6.0)
    (speed,) = measured_of(
        with_streams(one, pose=Stream(pose.time_s[seen], pose.values[seen], pose.channels)), SPEED_X
    )
    lost = (time_s > 4.1) & (time_s < 5.9)
    assert np.isnan(speed[lost]).all()
    assert np.isfinite(speed[~lost]).mean() > 0.95
    values = pose.values.copy()
    values[pose.time_s > 6.0, 0] += 3.0
    jumps = with_streams(without_channels(one, "speed_"), pose=Stream(pose.time_s, values, pose.channels))
    assert np.nanmax(np.abs(measured_of(jumps, SPEED_X))) < 1.0
    # a heading of a lidar leaves the pose
    heading = Stream(pose.time_s, np.zeros((len(pose), 1)), ("yaw_rate_radps",))
    assert np.isfinite(measured_of(with_streams(one, lidar=heading), SPEED_X)).mean() > 0.95
    none = {name: stream for name, stream in one.streams.items() if name not in ("pose", "wheels")}
    with pytest.raises(DataError, match="no stream 'wheels'"):
        signals_of(replace(one, streams=none), ROBOT)


@pytest.mark.slow
@pytest.mark.parametrize(("surface", "low", "high"), [("brown", 0.05, 0.2), ("gray", 0.25, 0.6)])
def test_rollers_of_measured_runs_are_named_and_explain_their_speed(measured, surface, low, high):
    """Ground softness times roller friction is what slip alone shows: 0.04 and 0.25."""
    root = measured("robotino") / "one_surface" / surface
    every = robotino.find_runs(root)
    runs = [with_wheel_speeds(read(), ROBOT) for read in every[:: len(every) // 15]]
    diagnosis = diagnose(runs, Simulation(ROBOT, scatter=spread_numbers("scatter")), showing("omni"))
    assert low < values_of(diagnosis)["roller_friction_ratio"].value < high
    before, after = diagnosis.residual_before["current_a"], diagnosis.residual_after["current_a"]
    assert after.rms < 0.5 * before.rms
