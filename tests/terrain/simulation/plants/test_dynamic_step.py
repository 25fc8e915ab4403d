import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import quad

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.plants.dynamic import (
    DEFLECTION_DAMPING_S,
    FIELD_STEP_M,
    LEG_FRICTION_NM,
    LEG_RATE_RADPS,
    ROLLING_SPEED_MPS,
    ROUGHNESS_CUTOFF,
    ROUGHNESS_WAVENUMBER,
    TerrainProfile,
    advance,
    check_step,
    make_plant,
    patches_on,
    settle,
    start_state,
)
from terrain.simulation.scenario import Conditions
from terrain.simulation.sensors import BODY_ROW, STEP_S, Motion
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import equilibrium_slip, wheel_ground

ROBOT = load_robot("agrimaro")
GEOMETRY = ROBOT.wheel_radius_m, ROBOT.body.tyre_width_m, ROBOT.body.contact_length_m
SUBSTEPS = 20
SOILS = ("asphalt", "grass", "tilled_loam")
CURVE = {"stiffness_ratio": 30.0, "shape_ratio": 1.6, "peak_friction_ratio": 1.5, "curvature_ratio": 0.5}
STICKY = Soil("sticky", "magic", 0.0, 0.0, 0.0, **CURVE)


class Driven(NamedTuple):
    """A plant on its terrain; numbers of the plant by name."""

    plant: np.ndarray
    profile: TerrainProfile

    def __getattr__(self, name):
        contacts = self.plant["contacts"][0, :3]
        value = contacts[name] if name in contacts.dtype.names else self.plant[name][0]
        return value[:3] if name in ("wheels_m", "radius_m") else value

    def changed(self, **numbers):
        plant, patches = self.plant.copy(), self.profile.patches.copy()
        for name, value in numbers.items():
            if name == "load_per_force_ratio":
                plant["contacts"][name][0, :3] = value
            else:
                (patches if name == "roughness_m3" else plant)[name] = value
        return Driven(plant, self.profile._replace(patches=patches))


def plant_of(*soils, roughness_m3=0.0, starts_m=(0.0,), backlash_rad=0.0, com_height_m=None, **changes):
    """Return the plant of the robot on even ground without scatter; no play unless it is asked for."""
    field = changes.pop("field", np.ones((2, 3, 1)))
    profile = TerrainProfile(patches_on(ROBOT, soils, [roughness_m3] * len(soils), starts_m), field)
    plant = Driven(make_plant(ROBOT, Conditions(**changes)), profile)
    if com_height_m is not None:
        ratio = plant.load_per_force_ratio * com_height_m / plant.com_height_m
        plant = plant.changed(com_height_m=com_height_m, load_per_force_ratio=ratio)
    return plant.changed(dead_band_rad=backlash_rad)


def drive(plant, wheel_radps, steer_rad=None, seed=None, settled=False, substeps=SUBSTEPS):
    """Return what happened under commands (n, 3) at 50 Hz, from rest."""
    wheel = np.array(wheel_radps, dtype=float)
    steer = np.zeros_like(wheel) if steer_rad is None else np.array(steer_rad, dtype=float)
    n = len(wheel) * substeps
    noise = np.zeros((n, 3)) if seed is None else np.random.default_rng(seed).standard_normal((n, 3))
    rows, state = np.empty(n, BODY_ROW), start_state(np.zeros(3))
    if settled:
        settle(*plant, state)
    held = (np.repeat(commands, substeps, axis=0) for commands in (wheel, steer))
    advance(*plant, state, *held, noise, rows)
    return Motion(rows)


def wheels(motion):
    return motion.record["wheels"][:, :3]


def ramp(duration_s, radps=5.0):
    """Return equal wheel commands (n, 3) that rise to a rate within a second."""
    return np.repeat(radps * np.minimum(np.arange(round(duration_s * 50)) / 50, 1.0)[:, None], 3, axis=1)


def steady_slip(plant, duration_s):
    return wheels(drive(plant, ramp(duration_s), settled=True))["slip_ratio"][-1]


def reference(plant, wheel_radps, steer_rad, substeps, noise, dt_s=STEP_S, steer_0=0.0):
    """Return speeds of the centre of mass, yaw, wheel rates, loads, slips and torques (n, ...): plain numpy.

    Written from the equations of the module's docstring; loads come of solving the balance of moments.
    """
    x, y = (plant.wheels_m - plant.com_m).T
    mass, height = plant.mass_kg, plant.com_height_m
    balance = np.vstack([np.ones(3), plant.wheels_m.T])
    v, accel, yaw, turn, path = np.zeros(2), np.zeros(2), 0.0, 0.0, 0.0
    rate, motor, motor_rate, torque, integral, estimate = np.zeros((6, 3))
    road, contact, ride, ride_rate, angle, count, reported = np.zeros((7, 3))
    deflection, steer, leg = np.zeros((2, 3)), np.full(3, steer_0), 0.0
    rows, grounds = [], plant.profile.patches["ground"]
    for k in range(len(noise)):
        c, s = math.cos(yaw), math.sin(yaw)
        undulation = plant.undulation_ratio * math.sin(2 * math.pi * path / plant.undulation_length_m)
        world = plant.grade_ratio + np.array([undulation, 0.0])
        grade = np.array([[c, s], [-s, c]]) @ world
        normal_g = GRAVITY_MPS2 / math.sqrt(1 + grade @ grade)

        error = steer_rad[k // substeps] - motor
        desired = np.sign(error) * np.sqrt(2 * plant.accel_max_radps2 * abs(error))
        desired = np.clip(desired, -plant.rate_max_radps, plant.rate_max_radps)
        desired = np.where(abs(error) < 1e-4, error / dt_s, desired)
        most = plant.accel_max_radps2 * dt_s
        motor_rate = motor_rate + np.clip(desired - motor_rate, -most, most)
        motor = motor + dt_s * motor_rate
        steer = np.clip(steer, motor - plant.dead_band_rad, motor + plant.dead_band_rad)

        heading = steer + np.array([0.0, 0.0, leg])
        ahead = np.array([np.cos(heading), np.sin(heading)])
        left = np.array([-ahead[1], ahead[0]])
        centre = np.array([v[0] - turn * y, v[1] + turn * x])
        along, across = (ahead * centre).sum(axis=0), (left * centre).sum(axis=0)
        wheel_speed = rate * plant.radius_m
        fastest = np.maximum(abs(wheel_speed), abs(along))

        speed = math.hypot(*v)
        reach = plant.wheels_m @ v / speed if speed > 0.05 else np.zeros(3)
        patch = np.maximum(
            np.searchsorted(plant.profile.patches["start_m"], path + reach, side="right") - 1, 0
        )

        rolled = np.hypot(along, across)
        white = noise[k] / math.sqrt(2 * dt_s)
        road = road + dt_s * 2 * math.pi * (
            ROUGHNESS_WAVENUMBER * np.sqrt(plant.profile.patches["roughness_m3"][patch] * rolled) * white
            - ROUGHNESS_CUTOFF * rolled * road
        )
        contact_rate = (road - contact) * np.minimum(2 * rolled / plant.contact_length_m, 1 / dt_s)
        contact = contact + dt_s * contact_rate
        ride_n = plant.tyre_stiffness_npm * (contact - ride) + plant.tyre_damping_nspm * (
            contact_rate - ride_rate
        )
        ride_rate = ride_rate + dt_s * ride_n / (mass * plant.load_fraction)
        ride = ride + dt_s * ride_rate

        pushed = mass * (accel + normal_g * grade)  # what the ground gives along the body's axes
        arms = mass * normal_g * plant.com_m - height * pushed
        normal = np.maximum(np.linalg.solve(balance, [mass * normal_g, *arms]) + ride_n, 0.0)

        def creep(wheel_speed, along=along, across=across, fastest=fastest, deflection=deflection):
            return np.array([wheel_speed - along, -across]) - fastest / plant.relaxation_length_m * deflection

        slip = (deflection + DEFLECTION_DAMPING_S * creep(wheel_speed)) / plant.relaxation_length_m
        got = np.array(
            [
                wheel_ground(grounds[patch[i]], normal[i], np.clip(slip[0, i], -1, 1), slip[1, i])
                for i in range(3)
            ]
        ).T
        cell = min(int(path / FIELD_STEP_M), plant.profile.field.shape[2] - 1)
        thrust, side = got[:2] * plant.profile.field[0, :, cell]
        pull = thrust - got[2] * plant.profile.field[1, :, cell] * np.tanh(along / ROLLING_SPEED_MPS)
        force = ahead * pull + left * side
        moment = (x * force[1] - y * force[0]).sum()

        lag = wheel_radps[k // substeps].clip(-plant.speed_max_radps, plant.speed_max_radps) - estimate
        asked = plant.speed_gain_nmspr * lag + integral
        free = (abs(asked) <= plant.torque_max_nm) | (asked * lag < 0)
        integral = integral + np.where(free, dt_s * plant.speed_integral_nmpr * lag, 0.0)
        asked = np.clip(asked, -plant.torque_max_nm, plant.torque_max_nm)
        torque = torque + (asked - torque) * dt_s / plant.torque_time_constant_s
        rest = torque - plant.friction_nm * np.tanh(rate / 0.1) - thrust * plant.radius_m
        body = [*v, yaw, turn, path]
        rows.append([*body, *rate, *heading, *normal, *torque, *ride, *reported, *patch, *asked])
        rate = rate + dt_s * rest / plant.wheel_inertia_kgm2
        estimate = estimate + (rate - estimate) * dt_s / plant.speed_estimate_time_constant_s
        angle = angle + dt_s * rate
        seen = np.floor(angle * plant.hall_steps) - count
        count = count + seen
        reported = (
            reported + (seen / plant.hall_steps / dt_s - reported) * dt_s / plant.encoder_time_constant_s
        )
        slide = creep(rate * plant.radius_m)
        deflection = np.clip(deflection + dt_s * slide, -plant.relaxation_length_m, plant.relaxation_length_m)

        leg_nm = -plant.wheels_m[2, 1] * force[0, 2]
        if abs(leg_nm) > LEG_FRICTION_NM:
            swung = leg + dt_s * LEG_RATE_RADPS * np.sign(leg_nm)
            leg = float(np.clip(swung, -plant.leg_backlash_rad, plant.leg_backlash_rad))
        accel = force.sum(axis=1) / mass - normal_g * grade
        v = v + dt_s * (accel + turn * np.array([v[1], -v[0]]))
        turn = turn + dt_s * moment / plant.yaw_inertia_kgm2
        yaw = yaw + dt_s * turn
        path = path + dt_s * math.hypot(v[0] + turn * plant.com_m[1], v[1] - turn * plant.com_m[0])
    names = ("speed_x", "speed_y", "yaw", "turn", "path")
    wheels = ("rate", "steer", "normal", "torque", "ride", "reported", "patch", "asked")
    table = np.array(rows)
    return {name: table[:, i] for i, name in enumerate(names)} | {
        name: table[:, 5 + 3 * i : 8 + 3 * i] for i, name in enumerate(wheels)
    }


def test_a_drive_with_everything_in_it_is_that_of_the_plain_form():
    rng = np.random.default_rng(3)
    load = {"payload_kg": 25.0, "payload_m": (0.1, -0.08), "radius_factors": (1.01, 0.99, 1.0)}
    land = {"grade_ratio": (0.04, -0.06), "undulation_ratio": 0.03, "undulation_length_m": 2.0}
    plant = plant_of(
        *map(load_soil, ("tiles", "clay", "grass")),
        **(load | land | {"roughness_m3": 5e-4, "starts_m": (0.0, 0.2, 0.6), "backlash_rad": 0.02}),
        leg_backlash_rad=0.03,
        field=rng.uniform(0.8, 1.2, (2, 3, 9)),
    )
    wheel, steer = 6 * rng.random((75, 3)), np.cumsum(0.1 * rng.standard_normal((75, 3)), axis=0)
    wheel[:5] *= -1.0
    noise = rng.standard_normal((75 * SUBSTEPS, 3))
    plain = reference(plant, wheel, steer, SUBSTEPS, noise, steer_0=0.015)
    rows, state = np.empty(len(noise), BODY_ROW), start_state(np.full(3, 0.015))
    held = (np.repeat(commands, SUBSTEPS, axis=0) for commands in (wheel, steer))
    advance(*plant, state, *held, noise, rows)
    of_wheel = rows["wheels"][:, :3]
    assert plain["path"][-1] > 0.7  # on all three grounds
    assert np.ptp(rows["leg_rad"]) > 0.03  # and through its play
    commanded_nm = np.abs(plain["asked"])  # at the limit, where the integral is kept, and below it
    assert (
        (commanded_nm == plant.torque_max_nm).any(axis=0) & (commanded_nm < plant.torque_max_nm).any(axis=0)
    ).all()
    turn, along, across = (rows[name] for name in ("yaw_rate_radps", "speed_x_mps", "speed_y_mps"))
    of_wheels = (
        ("wheel_radps", "rate"),
        ("steer_rad", "steer"),
        ("normal_n", "normal"),
        ("torque_nm", "torque"),
    )
    for name, found, expected in (
        *((name, rows[name], plain[twin]) for name, twin in (("yaw_rad", "yaw"), ("path_m", "path"))),
        *((name, of_wheel[name], plain[twin]) for name, twin in of_wheels),
        ("patches", of_wheel["patch_ratio"], plain["patch"]),
        ("rates as reported", of_wheel["reported_radps"][:-1], plain["reported"][1:]),
        ("yaw rate", turn, plain["turn"]),
        ("speed of the origin", along, plain["speed_x"] + plain["turn"] * plant.com_m[1]),
        ("speed to its left", across, plain["speed_y"] - plain["turn"] * plant.com_m[0]),
        # acceleration at the origin is what its speed does
        ("acceleration", rows["accel_x_mps2"][:-1], np.diff(along) / STEP_S - (turn * across)[:-1]),
        ("acceleration left", rows["accel_y_mps2"][:-1], np.diff(across) / STEP_S + (turn * along)[:-1]),
        # of the plane through the corners
        ("roll", rows["ride_roll_rad"], (plain["ride"][:, :2].mean(axis=1) - plain["ride"][:, 2]) / 0.756),
        ("pitch", rows["ride_pitch_rad"], (plain["ride"][:, 0] - plain["ride"][:, 1]) / 1.015),
    ):
        atol = {"normal_n": 1e-6, "torque_nm": 1e-7, "rates as reported": 1e-7}.get(name, 1e-9)
        np.testing.assert_allclose(found, expected, rtol=0, atol=atol, err_msg=name)


@pytest.mark.parametrize("name", ["asphalt", "grass", "clay", "dry_sand"])
@pytest.mark.parametrize("grade", [0.0, 0.03])
def test_steady_slip_is_that_at_which_a_wheel_pulls_its_share_of_the_hill(name, grade):
    soil = load_soil(name)
    plant = plant_of(soil, grade_ratio=(grade, 0.0), com_height_m=0.0)
    load_n = plant.mass_kg * GRAVITY_MPS2 / math.hypot(1.0, grade) / 3
    expected = equilibrium_slip(soil, load_n, load_n * grade, *GEOMETRY)
    np.testing.assert_allclose(steady_slip(plant, duration_s=15.0), expected, atol=1e-4)


def test_at_rest_on_the_level_nothing_at_all_happens():
    plant = plant_of(load_soil("grass"), roughness_m3=1e-3, backlash_rad=0.02)
    motion = drive(plant, np.zeros((100, 3)), seed=0)
    rows, of_wheels = motion.record, wheels(motion)
    bodies = rows[[name for name in rows.dtype.names if name not in ("wheels", "encoder_rad")]]
    assert (
        len({row.tobytes() for row in of_wheels})
        == len({row.tobytes() for row in np.array(bodies.tolist())})
        == 1
    )
    assert np.isnan([of_wheels["slip_ratio"], of_wheels["slip_angle_rad"]]).all()
    state = start_state(np.zeros(3))
    settle(*plant_of(load_soil("grass")), state)
    state["n_steps"] = 0
    assert state.tobytes() == start_state(np.zeros(3)).tobytes()


@pytest.mark.parametrize("name", ["tiles", "grass", "snow", "dry_sand"])
@pytest.mark.parametrize("uphill_rad", [0.0, 1.5, 2.4, 4.0])
def test_a_robot_at_rest_on_a_slope_of_5_degrees_does_not_move(name, uphill_rad):
    tan = math.tan(math.radians(5.0))
    grade_ratio = tan * math.cos(uphill_rad), tan * math.sin(uphill_rad)
    plant = plant_of(load_soil(name), grade_ratio=grade_ratio, backlash_rad=0.02)
    rows = drive(plant, np.zeros((500, 3)), settled=True).record
    moved_m = np.hypot(rows["position_x_m"], rows["position_y_m"])
    assert moved_m.max() < 5e-3  # sand, whose resistance is a viscous one at a crawl, takes its time
    assert moved_m[-1] - moved_m[-1001] < 1e-4
    assert np.abs(rows["yaw_rad"]).max() < 1e-3
    assert max(np.abs(rows[name]).max() for name in ("accel_x_mps2", "accel_y_mps2")) < 0.02
    weight_n = 90 * GRAVITY_MPS2 * math.cos(math.radians(5.0))
    np.testing.assert_allclose(rows["wheels"]["normal_n"][:, :3].sum(axis=1), weight_n)


@pytest.mark.parametrize("leg_backlash_rad", [0.0, 0.03])
def test_motor_work_in_curves_is_dissipated_by_lateral_slip_too(leg_backlash_rad):
    soil = load_soil("grass")
    plant = plant_of(soil, leg_backlash_rad=leg_backlash_rad)
    steer = np.clip(0.8 * np.sin(np.arange(400)[:, None] / 60), -0.5, 0.5) * [-1.0, 1.0, 0.4]
    rows = drive(plant, ramp(8.0, 7.0), steer, settled=True).record
    turn, names = rows["yaw_rate_radps"], ("steer_rad", "wheel_radps", "traction_n", "side_n", "normal_n")
    heading, rate, thrust, side, normal = (rows["wheels"][name][:, :3] for name in names)
    x, y = ROBOT.wheel_positions_m.T
    centre_x = rows["speed_x_mps"][:, None] - turn[:, None] * y
    centre_y = rows["speed_y_mps"][:, None] + turn[:, None] * x
    along = np.cos(heading) * centre_x + np.sin(heading) * centre_y
    across = -np.sin(heading) * centre_x + np.cos(heading) * centre_y
    resistance = soil.rolling_resistance_ratio * normal * np.tanh(along / ROLLING_SPEED_MPS)
    given, friction, rolling, slipping, sliding = (
        power_w.sum() * STEP_S
        for power_w in (
            *(rows["wheels"]["torque_nm"][:, :3] * rate, plant.friction_nm * np.tanh(rate / 0.1) * rate),
            *(resistance * along, thrust * (0.2 * rate - along), side * -across),
        )
    )
    v = np.array([rows["speed_x_mps"][-1] - turn[-1] * plant.com_m[1], rows["speed_y_mps"][-1]])
    stored = 0.5 * (90 * v @ v + 20.0 * turn[-1] ** 2 + plant.wheel_inertia_kgm2 * rate[-1] @ rate[-1])
    assert sliding > 0.02 * given
    assert given == pytest.approx(stored + friction + rolling + slipping + sliding, rel=5e-3)


@pytest.mark.parametrize("speed_mps", [0.5, 1.6])
def test_vibration_is_that_of_the_spectrum_of_the_road(speed_mps):
    """Two routes: the simulated corner, and ISO 8608 through the transfer functions of contact and tyre."""
    roughness_m3, body = 64e-6, ROBOT.body
    plant = plant_of(STICKY, roughness_m3=roughness_m3)
    rides = drive(plant, ramp(40.0, speed_mps / 0.2), seed=1).record["ride_z_mps2"]
    mass, stiffness, damping = 30.0, body.tyre_stiffness_npm, body.tyre_damping_nspm

    def density(f):
        cut_off = (ROUGHNESS_CUTOFF * speed_mps) ** 2
        road = ROUGHNESS_WAVENUMBER**2 * roughness_m3 * speed_mps / (f**2 + cut_off)
        s = 2j * math.pi * f
        contact = 1 / (1 + s * 0.5 * body.contact_length_m / speed_mps)
        tyre = s**2 * (damping * s + stiffness) / (mass * s**2 + damping * s + stiffness)
        return road * abs(contact * tyre) ** 2

    corner = math.sqrt(quad(density, 0.0, 500.0, points=[5.0, 7.0, 9.0, 50.0], limit=500)[0])
    # the mean of two corners; 40 s tell it to 2 %
    assert rides[2000:].std() == pytest.approx(corner / math.sqrt(2), rel=0.08)
    rougher = drive(plant.changed(roughness_m3=4 * roughness_m3), ramp(2.0, speed_mps / 0.2), seed=1)
    smooth = rides[:2000]
    np.testing.assert_allclose(rougher.record["ride_z_mps2"], 2 * smooth, rtol=0.02, atol=0.02 * smooth.std())


def accepted(plant):
    try:
        check_step(*plant, "agrimaro")
    except ConfigError:
        return False
    return True


def heaviest(plant):
    """The plant with the largest mass that is accepted, and the yaw inertia that goes with it."""
    low, high = 1.0, 1e6
    for _ in range(60):
        factor = math.sqrt(low * high)
        heavier = plant.changed(
            mass_kg=plant.mass_kg * factor, yaw_inertia_kgm2=plant.yaw_inertia_kgm2 * factor
        )
        low, high = (factor, high) if accepted(heavier) else (low, factor)
    assert accepted(plant)
    return plant.changed(mass_kg=plant.mass_kg * low, yaw_inertia_kgm2=plant.yaw_inertia_kgm2 * low)


def driven(plant, duration_s=6.0, seed=None):
    """What happens under equal commands that rise to 1 m/s within a second."""
    n = round(duration_s / STEP_S)
    wheel = np.repeat(5.0 * np.minimum(np.arange(n) * STEP_S, 1.0)[:, None], 3, axis=1)
    return drive(plant, wheel, seed=seed, settled=True, substeps=1)


@pytest.mark.parametrize("soil", SOILS)
def test_what_is_accepted_gains_no_momentum_that_the_motors_did_not_give(soil):
    """On ground as rough as a field, at the largest mass that is accepted."""
    plant = heaviest(plant_of(load_soil(soil), roughness_m3=load_soil(soil).roughness_m3))
    motion = driven(plant, seed=3)
    push_ns = STEP_S * np.cumsum((wheels(motion)["torque_nm"] / plant.radius_m).sum(axis=1))
    spin_ns = (plant.wheel_inertia_kgm2 * wheels(motion)["wheel_radps"] / plant.radius_m).sum(axis=1)
    momentum_ns = plant.mass_kg * motion.record["speed_x_mps"]
    # what resists only takes from it
    assert (momentum_ns <= push_ns - spin_ns + 0.01 * plant.mass_kg).all()
    changes_radps = np.abs(np.diff(wheels(motion)["wheel_radps"][-500:], axis=0))  # from step to step
    assert changes_radps.max() < 0.4


def test_a_light_robot_on_stiff_tyres_is_refused():
    plant = plant_of(load_soil("grass"))
    limit_kg = STEP_S * (STEP_S * plant.tyre_stiffness_npm + 2 * plant.tyre_damping_nspm) / 4
    for factor, even in ((0.99, False), (1.01, True)):
        mass_kg = factor * limit_kg / plant.load_fraction.min()
        light = plant.changed(mass_kg=mass_kg)
        assert accepted(light) == even
        load_n = wheels(driven(light.changed(roughness_m3=1e-6), 2.0, seed=4))["normal_n"]
        assert (np.isfinite(load_n).all() and load_n.max() < 100 * mass_kg * GRAVITY_MPS2) == even
