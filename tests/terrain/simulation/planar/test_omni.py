from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from terrain.effects import vector_of
from terrain.errors import ConfigError
from terrain.extension import apply_homes
from terrain.kinematics.logged_wheels import with_wheel_speeds
from terrain.kinematics.wheels import rolling_matrix
from terrain.robots import load_robot
from terrain.simulation.contact import softness
from terrain.simulation.planar.model import AMPS, SLIP, VX, VY, Ground, W, make_planar, planar_ground
from terrain.simulation.planar.motion import move
from terrain.simulation.planar.noise import load_noise
from terrain.simulation.planar.omni import ROLLING_MPS, SUBSTEPS, currents_of, steady_twist
from terrain.simulation.planar.run import simulate_planar
from terrain.simulation.run import simulate_run
from terrain.simulation.scenario import make_scenario
from terrain.slip_learning.measured import measured_slip
from terrain.terramechanics.soil import load_soil, soil_from

ROBOT = load_robot("robotino")
PLACE = ROBOT.wheel_positions_m, ROBOT.wheel_directions_rad
SOFT = 1.5
CARPET = Ground(slip_ratio=SOFT, rolling_ratio=0.0, roller_ratio=0.7 / SOFT)
NONE = vector_of({})
DT = 0.01


def centred(robot):
    return robot.with_parts(body=replace(robot.body, com_x_m=0.0, com_y_m=0.0))


def moved(robot, ground, wheels, p=NONE, grade=0.0, dt=DT):
    n = len(wheels)
    return move(
        make_planar(robot, ground),
        p,
        dt,
        wheels,
        np.zeros((n, 3)),
        np.full(n, grade),
        np.zeros(n),
        np.zeros((0, 3)),
    )


def wheels_for(twist, n=300):
    return np.tile(np.array(twist) @ rolling_matrix(*PLACE).T, (n, 1))


def heading_to(direction_rad, speed_mps=0.2):
    return speed_mps * np.cos(direction_rad), speed_mps * np.sin(direction_rad), 0.0


@pytest.mark.parametrize("twist", [(0.2, 0.1, 0.0), (0.0, -0.3, 0.0), (0.1, 0.0, 0.8)])
def test_without_friction_of_rollers_or_resistance_the_body_moves_as_its_wheels_roll(twist):
    steady = moved(centred(ROBOT), CARPET._replace(roller_ratio=0.0), wheels_for(twist))[-1]
    spin = abs(twist[2] * twist[0])  # a turn takes a force to the inside, and slip with it
    np.testing.assert_allclose(steady[[VX, VY, W]], twist, atol=1e-9 + spin * CARPET.slip_ratio)


@pytest.mark.parametrize("ratio", [0.04, 0.25, 0.8])
@pytest.mark.parametrize("direction_rad", [0.0, 0.7, 2.9, 4.4])
def test_steady_motion_is_that_of_the_balance_of_forces(ratio, direction_rad):
    wheels = wheels_for(heading_to(direction_rad))
    ground = CARPET._replace(roller_ratio=ratio / SOFT)
    load = make_planar(ROBOT, ground).wheel_load_ratio
    assert load.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(load @ PLACE[0], [ROBOT.body.com_x_m, ROBOT.body.com_y_m], atol=1e-12)
    expected = steady_twist(wheels[-1:], *PLACE, load, ratio)[0]
    found = moved(ROBOT, ground, wheels)[-1, [VX, VY, W]]
    # rollers turn the robot, which takes a force to the inside, and slip with it
    inside = 2.0 * CARPET.slip_ratio * abs(expected[2]) * np.hypot(*expected[:2]) / 9.8
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-4 + 0.2 * inside)
    assert found[2] == pytest.approx(expected[2], abs=1e-4 + inside / ROBOT.wheel_distance_m)


def test_slip_depends_on_the_direction_and_not_on_the_speed():
    slips = np.array(
        [
            [moved(ROBOT, CARPET, wheels_for(heading_to(a, speed)))[-1, SLIP] for speed in (0.2, 0.4)]
            for a in np.radians([0.0, 30.0, 60.0, 90.0])
        ]
    )
    np.testing.assert_allclose(slips[:, 0], slips[:, 1], atol=2e-3)
    assert np.ptp(slips[:, 0]) > 0.05


def test_with_equal_loads_a_third_of_a_turn_changes_nothing():
    for angle in (0.2, 1.1):
        one, other = (
            moved(centred(ROBOT), CARPET, wheels_for(heading_to(angle + more)))[-1]
            for more in (0.0, 2 * np.pi / 3)
        )
        assert one[SLIP] == pytest.approx(other[SLIP], abs=1e-9)
        turned = complex(one[VX], one[VY]) * np.exp(2j * np.pi / 3)
        np.testing.assert_allclose([other[VX], other[VY]], [turned.real, turned.imag], atol=1e-12)


def starting(n=60):
    ramp = np.minimum(np.arange(n) / 20.0, 1.0)[:, None]
    return ramp * np.array([0.15, 0.1, 0.6]) @ rolling_matrix(*PLACE).T


def law(planar, u, twist, stiff, rolling):
    """Forces and moment on the centre of mass, by the module's equation."""
    load = planar.wheel_load_ratio[:, None]
    v = planar.along @ twist
    drag = rolling * planar.mass_kg * 9.80665 * v / np.hypot(v, ROLLING_MPS)
    force = stiff * (u - v)[:, None] * planar.along - drag[:, None] * planar.along
    resists = planar.roller_ratio * planar.mass_kg * 9.80665 / speed_of(planar, u, twist)
    force -= resists * (planar.across @ twist)[:, None] * planar.across
    return (load * force).sum(axis=0)


def speed_of(planar, u, twist):
    fastest = max((u**2).mean(), ((planar.along @ twist) ** 2).mean())
    return np.sqrt(fastest + ROLLING_MPS**2)


def test_the_kernel_is_the_plain_form_of_its_implicit_steps():
    ground = CARPET._replace(rolling_ratio=0.02)
    planar, wheels = make_planar(ROBOT, ground), starting()
    masses = np.array([planar.mass_kg, planar.mass_kg, planar.yaw_inertia_kgm2])
    weight, step, twist, size, last = planar.mass_kg * 9.80665, DT / SUBSTEPS, np.zeros(3), 0.0, wheels[0]
    load, out = planar.wheel_load_ratio, []
    for row in wheels:
        for part in range(1, SUBSTEPS + 1):
            u = last + (row - last) * part / SUBSTEPS
            speed = speed_of(planar, u, twist)
            stiff = weight / softness(planar.soft_ratio, size) / speed
            drag = planar.rolling_ratio * weight / np.hypot(planar.along @ twist, ROLLING_MPS)
            balance = (planar.along.T * (load * (stiff + drag))) @ planar.along
            balance += (planar.across.T * (load * planar.roller_ratio * weight / speed)) @ planar.across
            turning = planar.mass_kg * twist[2] * np.array([twist[1], -twist[0], 0.0])
            driven = planar.along.T @ (load * stiff * u)
            twist = np.linalg.solve(
                np.diag(masses / step) + balance, masses / step * twist + turning + driven
            )
            size = min(np.sqrt(((u - planar.along @ twist) ** 2).mean()) / speed, 1.0)
        last = row
        out.append([twist[0] + twist[2] * planar.com_y_m, twist[1] - twist[2] * planar.com_x_m, twist[2]])
    np.testing.assert_allclose(moved(ROBOT, ground, wheels)[:, [VX, VY, W]], out, atol=1e-12)


def test_a_start_is_that_of_the_differential_equation():
    """The other route: an integrator that chooses its own steps."""
    ground = CARPET._replace(rolling_ratio=0.02)
    planar, wheels = make_planar(ROBOT, ground), starting()
    masses = np.array([planar.mass_kg, planar.mass_kg, planar.yaw_inertia_kgm2])
    time_s = DT * np.arange(len(wheels))

    def rate(t, twist):
        u = np.array([np.interp(t, time_s, column) for column in wheels.T])
        stiff = planar.mass_kg * 9.80665 / planar.soft_ratio[0] / speed_of(planar, u, twist)
        turning = np.array([twist[2] * twist[1], -twist[2] * twist[0], 0.0])
        return law(planar, u, twist, stiff, planar.rolling_ratio) / masses + turning

    twist = solve_ivp(rate, (0.0, time_s[-1]), np.zeros(3), "BDF", time_s, rtol=1e-7, atol=1e-9).y
    expected = [twist[0] + twist[2] * planar.com_y_m, twist[1] - twist[2] * planar.com_x_m, twist[2]]
    found = moved(ROBOT, ground, wheels)[:, [VX, VY, W]]
    step_s = DT / SUBSTEPS  # implicit steps are late by up to one
    fastest = np.abs(np.gradient(expected, DT, axis=1)).max(axis=1)
    assert (np.abs(found - np.transpose(expected)).max(axis=0) < 1.2 * step_s * fastest).all()


def test_currents_are_those_of_friction_where_nothing_resists_and_grow_with_the_rollers():
    planar = make_planar(centred(ROBOT), CARPET._replace(roller_ratio=0.0))
    wheels = wheels_for((0.3, 0.1, 0.0))
    free = moved(centred(ROBOT), CARPET._replace(roller_ratio=0.0), wheels)
    direction = wheels[-1] / np.hypot(wheels[-1], ROLLING_MPS)
    motors = ROBOT.motors
    per_a = motors.torque_constant_nmpa * motors.reduction_ratio * motors.efficiency_ratio
    each = currents_of(planar, NONE, DT, wheels, free)[-1]
    np.testing.assert_allclose(each, motors.friction_nm / per_a * direction, atol=1e-9)
    held = moved(centred(ROBOT), CARPET, wheels)
    assert held[-1, AMPS] > free[-1, AMPS] + 0.5


def test_motors_give_the_power_that_slip_and_rollers_take():
    planar, wheels = make_planar(ROBOT, CARPET), wheels_for((0.2, 0.15, 0.0))
    truth = moved(ROBOT, CARPET, wheels)
    twist = truth[-1, [VX, VY, W]]
    twist = twist + twist[2] * np.array([-planar.com_y_m, planar.com_x_m, 0.0])
    friction = planar.friction_nm / 3 * wheels[-1] / np.hypot(wheels[-1], ROLLING_MPS)
    torque = currents_of(planar, NONE, DT, wheels, truth)[-1] * planar.nm_per_a - friction
    u, v, across = wheels[-1], planar.along @ twist, planar.across @ twist
    scale = (
        planar.wheel_load_ratio * planar.mass_kg * 9.80665 / CARPET.slip_ratio / speed_of(planar, u, twist)
    )
    lost = (scale * ((u - v) ** 2 + SOFT * CARPET.roller_ratio * across**2)).sum()
    assert (torque / planar.radius_m * u).sum() == pytest.approx(lost, rel=1e-3)


def test_up_a_slope_the_body_slips_more_and_payload_changes_nothing_on_the_level():
    wheels = wheels_for((0.2, 0.0, 0.0))
    level, up = (moved(ROBOT, CARPET, wheels, grade=grade)[-1, SLIP] for grade in (0.0, 0.05))
    assert up == pytest.approx(level + 0.05 * SOFT / (1 + SOFT * CARPET.roller_ratio), abs=0.03)
    assert up > level + 0.02
    loaded = moved(ROBOT, CARPET, wheels, vector_of({"payload_ratio": 0.5}))[-1, SLIP]
    assert loaded == pytest.approx(level, abs=1e-6)


def driven(direction_rad, seed=0, ground=CARPET, speed_mps=0.2, seconds=6.0, effects=None):
    twist = np.zeros((int(50 * seconds) + 1, 3))
    twist[25:] = heading_to(direction_rad, speed_mps)
    run = simulate_planar(
        ROBOT, twist, seed, ground=ground, noise=load_noise(), terrain="carpet", effects=effects
    )
    return with_wheel_speeds(run, ROBOT)


def test_a_run_has_the_streams_of_a_measured_one_and_the_truth_and_the_same_bytes_by_seed():
    run, again, other = driven(1.0), driven(1.0), driven(1.0, seed=1)
    assert set(run.streams) == {"wheels", "pose", "commands", "truth"}
    assert run.streams["pose"].channels == ("position_x_m", "position_y_m", "yaw_rad")
    names = [f"motor_{i}_radps" for i in (1, 2, 3)] + [f"current_{i}_a" for i in (1, 2, 3)]
    assert set(names) < set(run.streams["wheels"].channels)
    for name, stream in run.streams.items():
        assert stream.values.tobytes() == again.streams[name].values.tobytes()
    assert (run.streams["pose"].values != other.streams["pose"].values).any()
    assert all((run.streams["wheels"].channel(f"current_{i}_a") >= 0.0).all() for i in (1, 2, 3))


@pytest.mark.parametrize("direction_rad", [0.3, 2.0, 5.1])
def test_measured_slip_of_a_simulated_run_is_its_truth(direction_rad):
    run = driven(direction_rad)
    found, truth = measured_slip(run, ROBOT), run.streams["truth"]
    steady = np.flatnonzero(found.steady & np.isfinite(found.body_slip))
    assert len(steady) >= 2
    for k in steady:
        inside = (truth.time_s >= found.start_s[k]) & (truth.time_s <= found.end_s[k])
        expected = truth.channel("slip_body_ratio")[inside].mean()
        assert found.body_slip[k] == pytest.approx(expected, abs=5 * found.body_slip_std[k] + 0.003)
        for i, wheel in enumerate(ROBOT.wheels):
            if np.isfinite(found.slip_ratio[k, i]) and abs(found.wheel_speed_mps[k, i]) > 0.1:
                slip = np.nanmean(truth.channel(f"slip_{wheel}_ratio")[inside])
                assert found.slip_ratio[k, i] == pytest.approx(slip, abs=5 * found.slip_std[k, i] + 0.01)


@pytest.mark.parametrize(
    "values",
    [
        {"load_shift_x_m": 0.02, "load_shift_y_m": -0.015},
        {"wheel_distance_ratio": 0.08},
        {"wheel_distance_ratio": -0.05, "load_shift_x_m": 0.01, "load_shift_y_m": 0.01},
        {"payload_ratio": 0.3},
        {"wheel_radius_ratio": -0.06},
    ],
)
def test_an_effect_with_a_home_moves_the_robot_as_that_description_does(values):
    """The other route: the kernel's geometry and loads against those of the description's numbers."""
    described = apply_homes(replace(ROBOT, effects=values))
    assert not described.effects
    wheels = starting() + wheels_for((0.1, -0.05, 0.3), 60)
    radius = described.wheel_radius_m / ROBOT.wheel_radius_m  # a larger wheel rolls further at one rate
    effect, expected = (
        moved(ROBOT, CARPET, wheels, vector_of(values)),
        moved(described, CARPET, radius * wheels),
    )
    np.testing.assert_allclose(effect[:, [VX, VY, W]], expected[:, [VX, VY, W]], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(effect[10:, AMPS], expected[10:, AMPS], rtol=0.02)  # rotors: by the rate


def test_what_the_ground_adds_to_the_motion_is_in_no_current():
    """Noise of the motion has no force: measured currents are those of the motion without it."""
    quiet = load_noise()._replace(along_ratio=0.0, across_ratio=0.0, yaw_radps=0.0)
    rough = load_noise()._replace(along_ratio=0.05, across_ratio=0.05, yaw_radps=0.05)
    twist = np.zeros((301, 3))
    twist[25:] = heading_to(0.4)
    one, other = (
        simulate_planar(ROBOT, twist, 3, ground=CARPET, noise=noise).streams for noise in (quiet, rough)
    )
    moved_by = np.abs(one["truth"].channel("speed_y_mps") - other["truth"].channel("speed_y_mps"))
    assert moved_by.max() > 0.002
    for i in (1, 2, 3):
        name = f"current_{i}_a"
        np.testing.assert_allclose(one["wheels"].channel(name), other["wheels"].channel(name), atol=1e-9)
    with pytest.raises(ConfigError, match="stick_slip_a is not simulated of robot robotino"):
        simulate_planar(ROBOT, twist, 3, ground=CARPET, outside={"stick_slip_a": 1.0})


def test_scenarios_take_an_omni_robot_sideways_at_a_speed_of_its_own():
    crab = make_scenario("crab", ROBOT, "tiles")
    assert np.abs(crab.twist[:, 1]).max() > 0.1
    assert np.abs(make_scenario("straight", ROBOT, "tiles").twist[:, 0]).max() == pytest.approx(0.94 / 3)
    run = simulate_run(ROBOT, "tiles", "crab", 3)
    assert "pose" in run.streams
    with pytest.raises(ConfigError, match="scenario 'course' is"):
        make_scenario("course", ROBOT, ["tiles", "grass"])


def test_a_soil_says_what_it_does_to_rollers():
    assert planar_ground(ROBOT, load_soil("tiles")).roller_ratio == 0.0
    entry = {"unit": "ratio", "source": "test"}
    values = {
        "rolling_resistance_ratio": 0.01,
        "slip_sinkage_ratio": 0.0,
        "stiffness_ratio": 1.0,
        "shape_ratio": 1.3,
        "peak_friction_ratio": 0.5,
        "curvature_ratio": 0.5,
        "roller_friction_ratio": 0.4,
    }
    described = {name: {"value": value, **entry} for name, value in values.items()}
    described |= {"name": "carpet", "law": "magic"}
    described["roughness_m3"] = {"value": 4e-6, "unit": "m3", "source": "test"}
    assert planar_ground(ROBOT, soil_from("carpet.yaml", described)).roller_ratio == 0.4
    described["roller_friction_ratio"]["value"] = -0.1
    with pytest.raises(ConfigError, match=r"carpet.yaml: roller_friction_ratio.*-0.1"):
        soil_from("carpet.yaml", described)
