"""The car: laws, an independent integration, rest on a slope, stops, what a controller is given, bad settings."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.plants import car
from terrain.simulation.run import simulate

ROBOT = load_robot("adap2e")


def drive(steer_rad, speed_mps, seconds, ground, start=None, **settings):
    """Return bodies (n,) at 100 Hz and the state at the end."""
    rows = np.empty(round(seconds * 100), car.CAR_BODY)
    state = car.initial_state(speed_mps=speed_mps) if start is None else start
    numbers = car.car_record(ROBOT, **settings)
    car.advance(numbers, car.ground_grid(ground), state, steer_rad, speed_mps, rows, 10)
    return rows, state


def columns(rows, *names):
    return np.column_stack([rows[name] for name in names])


def test_plant_agrees_with_an_integration_of_its_equations():
    speed, grip, roll, steer = 4.0, 0.6, 0.1, 0.12
    mass, inertia = ROBOT.mass_kg, ROBOT.yaw_inertia_kgm2
    ahead, behind = ROBOT.com_ahead_m, ROBOT.com_behind_front_m

    def force(tangent, stiffness, load):
        limit, slip = grip * load, np.arctan(tangent)
        return -limit * (1 - np.exp(-stiffness * abs(slip) / limit)) * np.sign(slip)

    def rates(_, y):
        _, _, yaw, side, turning, front, rear = y
        load = mass * GRAVITY_MPS2 * np.cos(roll) / 2
        at_front, at_rear = side + behind * turning, side - ahead * turning
        f_front = force(front, ROBOT.front_cornering_npr, load) * np.cos(steer)
        f_rear = force(rear, ROBOT.rear_cornering_npr, load)
        v_side = at_front * np.cos(steer) - speed * np.sin(steer)
        v_ahead = speed * np.cos(steer) + at_front * np.sin(steer)
        return [
            speed * np.cos(yaw) - at_rear * np.sin(yaw),
            speed * np.sin(yaw) + at_rear * np.cos(yaw),
            turning,
            (f_front + f_rear) / mass - GRAVITY_MPS2 * np.sin(roll) - speed * turning,
            (behind * f_front - ahead * f_rear) / inertia,
            (v_side - abs(v_ahead) * front) / 0.3,
            (at_rear - speed * rear) / 0.3,
        ]

    start = car.initial_state(speed_mps=speed)
    start["body"]["steer_rad"] = steer
    rows, _ = drive(steer, speed, 3.0, car.level_ground(grip, roll), start, delay_steps=0, damping_ratio=0.0)
    exact = solve_ivp(rates, (0.0, 3.0), np.zeros(7), rtol=1e-9, atol=1e-10).y[:, -1]
    assert columns(rows, "position_x_m", "position_y_m")[-1] == pytest.approx(exact[:2], abs=0.01)
    assert columns(rows, "side_speed_mps", "yaw_rate_radps")[-1] == pytest.approx(exact[3:5], rel=2e-3)


def test_robot_stops_exactly_and_holds_on_a_slope_without_creep():
    ground = car.level_ground(0.7, np.deg2rad(15.0))
    _, state = drive(0.1, 3.0, 3.0, ground)
    rows, _ = drive(0.1, 0.0, 15.0, ground, state)
    assert (rows["speed_mps"][500:] == 0.0).all()
    poses = columns(rows[500:], "position_x_m", "position_y_m", "yaw_rad")
    assert np.ptp(poses, axis=0) == pytest.approx(0.0, abs=1e-6)
    end = rows[-1]
    held = end["side_front_n"] * np.cos(end["steer_rad"]) + end["side_rear_n"]
    assert held == pytest.approx(ROBOT.mass_kg * GRAVITY_MPS2 * np.sin(np.deg2rad(15.0)), rel=1e-6)


def test_steering_has_dead_time_rate_and_limit():
    rows, _ = drive(1.0, 2.0, 2.0, car.level_ground(), delay_steps=100)
    steer, fine = rows["steer_rad"], np.empty(110, car.CAR_BODY)
    delayed = car.car_record(ROBOT, delay_steps=100), car.ground_grid(car.level_ground()), car.initial_state()
    car.advance(*delayed, 1.0, 2.0, fine, 1)
    assert np.flatnonzero(fine["steer_rad"])[0] == 100
    assert np.diff(steer).max() <= ROBOT.steering_rate_radps * 0.01 + 1e-9
    assert steer[-1] == pytest.approx(ROBOT.steering_max_rad, rel=1e-3)
    assert (steer <= ROBOT.steering_max_rad).all()


def test_ground_that_cannot_be_is_refused():
    for distance, grip, roll in (
        *(([0.0, 0.0], [0.5, 0.5], [0, 0]), ([0.0], [0.0], [0.0])),
        *(([0.0], [0.5], [1.0]), ([0.0], [0.5], [np.nan])),
    ):
        with pytest.raises(ConfigError, match="ground"):
            car.ground_grid(car.Ground(np.array(distance), np.array(grip), np.array(roll)))


def weave(sample):
    return car.CarCommand(0.1 * np.sin(sample.time_s), sample.speed_desired_mps)


STOPS = car.CarDrive(3.0, ((15.0, 2.0),), duration_s=20.0)


def run(controller=weave, drive=STOPS, ground=None):
    return simulate(ROBOT, drive, ground or car.level_ground(0.7, 0.1), 3, controller=controller)


def test_specific_force_of_a_robot_at_rest_on_a_slope_is_gravity():
    log = run(drive=car.CarDrive(0.0, duration_s=4.0), ground=car.level_ground(0.7, 0.2))
    accel = log.streams["imu"].values[200:, 3:6].mean(axis=0)
    assert accel == pytest.approx(GRAVITY_MPS2 * np.array([0.0, np.sin(0.2), np.cos(0.2)]), abs=0.05)
    assert np.isnan(log.streams["truth"].channel("slip_rear_rad")[200:]).all()


def test_robot_stops_where_its_drive_says_for_as_long_and_a_controller_is_given_what_is_logged():
    seen = []
    log = run(lambda sample: seen.append(sample.measured) or weave(sample))
    streams, rows = log.streams, np.array(seen)
    truth = streams["truth"]
    stands = (truth.channel("speed_x_mps") == 0.0) & (truth.time_s > 1.0)
    assert truth.channel("distance_m")[stands] == pytest.approx(15.0, abs=0.1)
    assert stands.sum() / 100 == pytest.approx(2.0, abs=0.1)
    assert (streams["wheels"].values[stands[::2], 0] == 0.0).all()
    assert rows[:, 0] == pytest.approx(streams["wheels"].values[:, 0])
    assert rows[:, 5] == pytest.approx(streams["imu"].channel("gyro_z_radps")[::2])
    assert rows[::5, 2] == pytest.approx(streams["gnss"].channel("position_x_m"))


def test_commands_that_are_no_numbers_and_speeds_beyond_the_robot_are_refused():
    with pytest.raises(ConfigError, match="controller commands"):
        run(lambda sample: car.CarCommand(float("nan"), 1.0))
    with pytest.raises(ConfigError, match="range"):
        run(drive=car.CarDrive(20.0))
