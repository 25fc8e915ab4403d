import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.estimate import estimate_run
from terrain.estimation.feed import on_clock
from terrain.records import Label, RunLog, Stream
from terrain.robots import load_robot
from terrain.simulation.run import Drive, scenario_of, simulate, simulate_run
from terrain.simulation.scenario import Conditions
from terrain.slip_learning.forces import (
    body_balance,
    contact_slip,
    traction_samples,
    wheel_forces,
    wheel_loads,
)
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import net_pull

ROBOT = load_robot("agrimaro")


def driven(terrain, drive, seed=0, **conditions):
    soils = {terrain: load_soil(terrain)}
    run = simulate(ROBOT, scenario_of(drive, terrain), soils, seed, conditions=Conditions(**conditions))
    return run, forces_of(run)


def forces_of(run):
    found = estimate_run(run, ROBOT, "vio15")
    return wheel_forces(run, ROBOT, found.track, found.table, found.slip)


def true_wheels(run, forces, pattern):
    truth = run.streams["truth"]
    rows = {str(i): truth.channel(pattern.format(i)) for i in (1, 2, 3)}
    lag_s = ROBOT.sensors.encoder_time_constant_s
    return np.column_stack(list(on_clock(forces.time_s, truth.time_s, rows, lag_s).values()))


@pytest.fixture(scope="module")
def starts():
    return driven("grass", Drive("starts", 1.5, 1.2), roughness_factor=0.1)


def test_thrust_load_and_slip_of_a_run_are_near_the_truth(starts):
    run, forces = starts
    for found, pattern, tolerance in (
        (forces.thrust_n, "traction_{}_n", 3.0),  # 1 % of the load; current noise alone is half of it
        (forces.load_npkg * ROBOT.mass_kg, "normal_{}_n", 15.0),
        (forces.slip_ratio, "slip_{}_ratio", 0.03),  # of the contact, 5 cm behind in a start
    ):
        error = (found - true_wheels(run, forces, pattern))[forces.valid]
        assert len(error) > 1000
        assert abs(np.mean(error)) < tolerance / 3
        assert np.std(error) < 2 * tolerance


def test_samples_lie_on_the_curve_of_the_soil(starts):
    run, forces = starts
    samples = traction_samples(forces, ROBOT.mass_kg, forces.on_terrain(run.labels, "grass"), 0.008)
    body = ROBOT.body
    load_n = ROBOT.mass_kg * GRAVITY_MPS2 / 3
    geometry = ROBOT.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    soil = load_soil("grass")
    net = net_pull(soil, load_n, np.append(samples.slip_ratio, 0.0), *geometry) / load_n
    true = net[:-1] - net[-1]
    assert samples.slip_ratio.max() > 0.35
    assert np.median(np.abs(samples.traction_ratio / true - 1)[samples.slip_ratio > 0.1]) < 0.05


def test_balance_finds_mass_and_resistance_with_a_payload():
    run, forces = driven("asphalt", Drive("starts", 1.5, 1.2), payload_kg=20.0)
    found = body_balance(forces, ROBOT, forces.on_terrain(run.labels, "asphalt"))
    assert abs(found.mass_kg - 110.0) < 3 * found.mass_std_kg < 15.0
    assert abs(found.resistance_ratio - 0.015) < 2 * found.resistance_std
    nowhere = body_balance(forces, ROBOT, np.zeros(len(forces.time_s), dtype=bool))
    assert np.isnan(nowhere.resistance_ratio)
    assert nowhere.mass_kg == ROBOT.mass_kg


def test_mass_is_not_estimated_from_a_robot_that_hardly_moves():
    """On a steep slope of sand it digs in: a fifth of its mass would be found, with a small error."""
    grade = Conditions(grade_ratio=(0.08, 0.0))
    run = simulate_run(ROBOT, "dry_sand", "starts", 2001, 5, vary=True, conditions=grade)
    forces = forces_of(run)
    found = body_balance(forces, ROBOT, forces.on_terrain(run.labels, "dry_sand"))
    assert abs(found.mass_kg - ROBOT.mass_kg) < 45.0
    assert found.resistance_ratio < 0.5


def test_reversing_counts_as_traction_and_a_slope_shifts_load():
    ahead = scenario_of(Drive("starts", 1.5, 1.0, 10.0), "grass")
    twist = -ahead.twist
    backward = type(ahead)("back", ahead.rate_hz, ahead.time_s, twist, ahead.patches)
    run = simulate(ROBOT, backward, {"grass": load_soil("grass")}, 0)
    forces = forces_of(run)
    good = forces.valid & (true_wheels(run, forces, "slip_{}_ratio") < -0.05)
    assert good.sum() > 100
    assert (forces.slip_ratio[good] > 0).all()
    assert np.mean(forces.thrust_n[good] > 0) > 0.99
    climbing = wheel_loads(ROBOT, np.array([[1.0, 0.0, 9.7], [0.0, 1.0, 9.7]]))
    np.testing.assert_allclose(climbing.sum(axis=1), 9.7)
    assert climbing[0, 0] > climbing[0, 1]
    assert (
        climbing[1, 2] > climbing[1, 0]
    )  # the third wheel stands to the right: speeding up to the left loads it


def test_contact_slip_settles_at_the_slip_ratio_over_its_relaxation_length():
    time_s = np.arange(0.0, 3.0, 0.02)
    wheel_speed, ground, length_m = 1.0, 0.8, 0.05
    slip = contact_slip(time_s, np.full(150, wheel_speed - ground), np.full(150, wheel_speed), length_m)
    np.testing.assert_allclose(slip, 0.2 * (1 - np.exp(-time_s * wheel_speed / length_m)), atol=1e-12)
    still = contact_slip(time_s, np.zeros(150), np.zeros(150), length_m)
    assert not still.any()


def test_samples_after_a_change_of_terrain_are_left_out_but_not_at_the_ends(starts):
    _, forces = starts
    end_s = forces.time_s[-1]
    labels = (Label(0.0, 10.0, "grass"), Label(10.0, end_s + 1, "clay"))
    grass, clay = forces.on_terrain(labels, "grass"), forces.on_terrain(labels, "clay")
    assert grass[0]
    assert clay[-1]
    assert not (clay & (forces.time_s < 10.3 - 1e-9)).any()


def test_a_log_without_current_or_attitude_and_a_filter_without_slip_speeds_are_refused(starts):
    run, _ = starts
    found, blind = (estimate_run(run, ROBOT, name) for name in ("vio15", "vio12"))
    for stream, channel in (("wheels", "current_2_a"), ("imu", "pitch_rad"), ("imu", None)):
        streams, left = dict(run.streams), run.streams[stream].channels
        removed = streams.pop(stream)
        if channel is not None:
            left = tuple(name for name in left if name != channel)
            streams[stream] = Stream(removed.time_s, removed.columns(left), left)
        bare = RunLog("bare", run.robot, streams, run.labels)
        with pytest.raises(DataError, match=f"run bare: stream '{stream}' has no channel '{channel or ''}"):
            wheel_forces(bare, ROBOT, found.track, found.table, found.slip)
    with pytest.raises(DataError, match="has no slip speeds"):
        wheel_forces(run, ROBOT, blind.track, blind.table, blind.slip)
