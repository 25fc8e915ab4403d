"""The dynamic plant of every drive: laws that hold whatever turns the wheels, two routes, and contracts."""

import dataclasses
import math

import numpy as np
import pytest

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.files.names import packaged
from terrain.kinematics.commands import wheel_motion
from terrain.records import Command
from terrain.robots import (
    Antenna,
    BicycleRobot,
    MecanumRobot,
    OmniRobot,
    SkidSteerRobot,
    TrackedRobot,
    TricycleRobot,
    load_robot,
)
from terrain.simulation.assumed import with_assumed
from terrain.simulation.plants.dynamic import (
    TerrainProfile,
    advance,
    make_plant,
    patches_on,
    settle,
    start_state,
)
from terrain.simulation.plants.planar import planar_ground
from terrain.simulation.run import simulate, simulate_run
from terrain.simulation.scenario import STAND, Conditions, Leg, from_legs
from terrain.simulation.sensors import BODY_ROW, Gnss, Poses
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import wheel_ground

SKID = SkidSteerRobot("mine", 0.165, 0.57, 0.512, 50.0)
TRACKED = TrackedRobot("tracks", 0.12, 0.5, 0.7, 52.0)
OMNI = OmniRobot("omni", 0.06, 0.35, 0.30, 14.0)
MECANUM = MecanumRobot("mecanum", 0.08, 0.4, 0.5, 25.0)
CAR = BicycleRobot("car", 0.3, 0.9, 1.2, 420.0)
TRICYCLE = TricycleRobot("tricycle", 0.2, 0.8, 1.4, 60.0, com_ahead_m=0.6)
SWERVE = load_robot("agrimaro")
ROBOTS = [SKID, TRACKED, OMNI, MECANUM, CAR, TRICYCLE, SWERVE]
SYMMETRIC = [robot for robot in ROBOTS if robot is not SWERVE]
EVEN = {name: dataclasses.replace(load_soil(name), scatter=()) for name in ("grass", "asphalt", "clay")}
LINEAR = Soil(
    "linear",
    "magic",
    0.0,
    0.0,
    0.0,
    stiffness_ratio=1.0,
    shape_ratio=1.2,
    peak_friction_ratio=0.9,
    curvature_ratio=0.0,
    roller_friction_ratio=0.2,
)
SMOOTH = Conditions(roughness_factor=0.0)

of_drives = pytest.mark.parametrize("robot", ROBOTS, ids=lambda robot: robot.drive)


def drive(robot, twist, hold_s=8.0, soil="asphalt", conditions=SMOOTH, **options):
    """Return the run of a twist that is driven to from rest, and held."""
    legs = [STAND, Leg(np.array(twist, dtype=float), hold_s)]
    soils = {soil: EVEN[soil]} if isinstance(soil, str) else {soil.name: soil}
    scenario = from_legs("held", next(iter(soils)), legs)
    return simulate(robot, scenario, soils, 0, conditions=conditions, **options)


def end(run, *channels):
    """Return means over the last two seconds of the truth, of one channel or of several."""
    means = [float(run.streams["truth"].channel(channel)[-200:].mean()) for channel in channels]
    return means if len(means) > 1 else means[0]


def free(robot, soil="asphalt"):
    """Return a plant without motors, its smooth terrain, and a state at rest."""
    robot = with_assumed(robot)
    plant = make_plant(robot, SMOOTH)
    profile = TerrainProfile(patches_on(robot, [EVEN[soil]], [0.0], [0.0]), np.ones((2, 8, 1)))
    plant["driven"], state = 0, start_state(np.zeros(len(robot.wheels)))
    settle(plant, profile, state)
    return plant, profile, state


def roll(plant, profile, state, duration_s):
    still, rows = np.zeros((round(1000 * duration_s), 8)), np.empty(round(1000 * duration_s), BODY_ROW)
    advance(plant, profile, state, still, still, still, rows)
    return rows


@of_drives
def test_at_rest_a_robot_stays_at_rest_on_rough_ground(robot):
    truth = drive(robot, (0.0, 0.0, 0.0), 2.0, conditions=None).streams["truth"]
    moving = np.column_stack(
        [truth.channel(name) for name in truth.channels if name.endswith(("mps", "radps"))]
    )
    assert (np.abs(moving[:, :-1]) < 1e-12).all()  # the last is the bias of the gyro
    assert "slip_1_ratio" not in truth.channels


@of_drives
@pytest.mark.parametrize("soil", ["asphalt", "grass"])
def test_without_motors_energy_never_grows(robot, soil):
    plant, profile, state = free(robot, soil)
    state["speed_x_mps"], state["speed_y_mps"], state["yaw_rate_radps"] = 0.8, 0.3, 0.5
    n, com = int(plant["n_wheels"][0]), plant["com_m"][0]
    rows = roll(plant, profile, state, 4.0)
    turn, rates = rows["yaw_rate_radps"], rows["wheels"]["wheel_radps"][:, :n]
    v = rows["speed_x_mps"] - turn * com[1], rows["speed_y_mps"] + turn * com[0]
    stored_j = 0.5 * (plant["mass_kg"] * (v[0] ** 2 + v[1] ** 2) + plant["yaw_inertia_kgm2"] * turn**2)
    stored_j = stored_j + 0.5 * plant["wheel_inertia_kgm2"] * (rates**2).sum(axis=1)
    # contacts give back what they stored: at most their grip over the deflection at which it is reached
    least_j, elastic_j = (
        np.minimum.accumulate(stored_j),
        0.15 * plant["relaxation_length_m"] * plant["weight_n"],
    )
    assert (stored_j <= least_j + elastic_j).all()
    assert stored_j[-1] < 0.5 * stored_j[0]


@pytest.mark.parametrize("robot", SYMMETRIC, ids=lambda robot: robot.drive)
@pytest.mark.parametrize("soil", ["asphalt", "grass"])
def test_what_is_mirrored_drives_in_the_mirror(robot, soil):
    y_mps = 0.1 if robot.sideways else 0.0
    left, right = (
        drive(robot, (0.3, side * y_mps, side * 0.25), soil=soil).streams["truth"] for side in (1, -1)
    )
    for name, sign in (("speed_x_mps", 1), ("speed_y_mps", -1), ("yaw_rate_radps", -1), ("pitch_rad", 1)):
        np.testing.assert_allclose(left.channel(name), sign * right.channel(name), atol=1e-7, err_msg=name)


@pytest.mark.parametrize("robot", [r for r in ROBOTS if not r.on_omni_wheels], ids=lambda robot: robot.drive)
@pytest.mark.parametrize("soil", ["asphalt", "clay"])
def test_steady_slip_is_that_of_the_law_of_the_soil_for_load_and_resistance(robot, soil):
    """Each driven wheel is on its curve at its load, and together they pull what resists all."""
    robot, flat = with_assumed(robot), EVEN[soil]
    robot = robot.with_parts(body=dataclasses.replace(robot.body, com_height_m=0.0))
    if robot.steered:
        robot = robot.with_parts(steering=dataclasses.replace(robot.steering, dead_band_rad=0.0))
    run = drive(robot, (0.4, 0.0, 0.0), 15.0, soil=soil)
    ground, plant = patches_on(robot, [flat], [0.0], [0.0])["ground"][0], make_plant(robot, SMOOTH)[0]
    shares = np.bincount(plant["contacts"]["wheel"][: plant["n_contacts"]])
    pulled, resisting = 0.0, 0.0
    for wheel, share in zip(robot.wheels, shares.tolist(), strict=True):
        slip, normal, traction = end(run, f"slip_{wheel}_ratio", f"normal_{wheel}_n", f"traction_{wheel}_n")
        thrust, _, resistance, _ = np.array(wheel_ground(ground, normal / share, slip, 0.0)) * share
        if (robot.drive, wheel) == ("bicycle", "rear"):  # in the ruts of the front wheels
            resistance = normal * flat.rolling_resistance_ratio
        assert traction == pytest.approx(thrust, abs=2e-3 * normal)
        pulled, resisting = pulled + traction, resisting + resistance
    assert pulled == pytest.approx(resisting, rel=0.02)


@of_drives
def test_vibration_grows_with_roughness_and_current_with_resistance(robot):
    conditions = (Conditions(roughness_factor=factor) for factor in (1.0, 4.0))
    smooth, rough = (
        drive(robot, (0.4, 0.0, 0.0), 4.0, conditions=each).streams["imu"] for each in conditions
    )
    at_rest, *shaken = (
        part.channel("accel_z_mps2")[where].var()
        for part, where in ((smooth, slice(80)), (smooth, slice(200, None)), (rough, slice(200, None)))
    )
    ratio = math.sqrt((shaken[1] - at_rest) / (shaken[0] - at_rest))
    assert ratio == pytest.approx(2.0, rel=0.2)  # as the root of the roughness
    currents = []
    for resistance in (0.02, 0.06):
        soil = dataclasses.replace(LINEAR, rolling_resistance_ratio=resistance, roller_friction_ratio=0.0)
        wheels = drive(robot, (0.4, 0.0, 0.0), 6.0, soil=soil).streams["wheels"]
        names = [f"current_{wheel}_a" for wheel in robot.logged_wheels]
        currents.append(sum(abs(wheels.channel(name)[-100:].mean()) for name in names))
    more_n = 0.04 * robot.mass_kg * GRAVITY_MPS2
    if robot.on_omni_wheels:  # whose wheels pull askew
        assert currents[1] > currents[0]
    else:
        more_a = more_n * robot.wheel_radius_m / with_assumed(robot).motors.nm_per_a
        assert currents[1] - currents[0] == pytest.approx(more_a, rel=0.1)


def test_a_skid_steer_robot_turns_slower_than_its_wheels_say():
    husky = load_robot("husky")
    run = drive(husky, (0.4, 0.0, 0.6), soil="grass")
    left, right, turn = end(run, "wheel_left_radps", "wheel_right_radps", "yaw_rate_radps")
    assert 1.3 < (right - left) * husky.wheel_radius_m / (husky.track_m * turn) < 2.5  # measured: 1.5 to 2


@pytest.mark.parametrize("robot", [OMNI, MECANUM, SWERVE], ids=lambda robot: robot.drive)
def test_what_drives_sideways_does(robot):
    run = drive(robot, (0.0, 0.2, 0.0), 10.0)
    ahead, left, turn = end(run, "speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    assert (ahead, left, turn) == (
        pytest.approx(0.0, abs=0.01),
        pytest.approx(0.2, rel=0.03),
        pytest.approx(0, abs=0.02),
    )


@pytest.mark.parametrize(
    ("robot", "twist"),
    [(robot, twist) for robot in (OMNI, MECANUM) for twist in ((0.2, 0.0, 0.0), (0.0, 0.2, 0.0))]
    + [(OMNI, (0.15, 0.1, 0.0))],
)
def test_rollers_slip_as_in_the_planar_plant(robot, twist):
    """Two routes: contacts on a curve each, and one straight curve for all at their common slip.

    The planar plant has its curve by the slip of the wheel, the contacts by that along the axis of the roller, which
    is ``cos(g)`` of it, and so is the force.
    """
    robot = with_assumed(robot)
    straight = dataclasses.replace(
        LINEAR, stiffness_ratio=math.cos(robot.roller_angles_rad[0]) ** 2 * LINEAR.stiffness_ratio
    )
    scenario = from_legs("held", "linear", [STAND, Leg(np.array(twist), 10.0)])
    planar = simulate(robot, scenario, planar_ground(robot, straight), 0)
    names, arm_m = (
        ("speed_x_mps", "speed_y_mps", "yaw_rate_radps"),
        np.array([1.0, 1.0, robot.wheel_distance_m]),
    )
    found, expected = arm_m * [end(run, *names) for run in (drive(robot, twist, 10.0, soil=LINEAR), planar)]
    lost = np.abs(np.array(twist) - expected).max()
    assert lost > 0.01 or (robot.drive, twist[1]) == (
        "mecanum",
        0.0,
    )  # straight ahead its rollers do not turn
    np.testing.assert_allclose(found, expected, atol=max(0.2 * lost, 1e-3))


@pytest.mark.parametrize("robot", [CAR, TRICYCLE], ids=lambda robot: robot.drive)
def test_at_low_speed_a_car_is_the_kinematic_bicycle(robot):
    run = drive(robot, (0.5, 0.0, 0.1), 10.0)
    speed, left, turn, steer = end(run, "speed_x_mps", "speed_y_mps", "yaw_rate_radps", "steer_front_rad")
    assert math.tan(steer) == pytest.approx(robot.wheelbase_m * 0.2, rel=1e-3)
    assert turn == pytest.approx(speed * math.tan(steer) / robot.wheelbase_m, rel=0.02)
    assert left == pytest.approx(0.0, abs=0.01)


def follow(robot):
    """Return a controller that commands what the open loop does."""
    steer = np.zeros(len(robot.wheels))

    def controller(sample):
        motion = wheel_motion(robot, np.vstack([sample.twist, sample.twist]), 0.02)
        return Command(
            motion.wheel_radps[0], motion.steer_rad[0] if robot is not SWERVE else steer, sample.twist, {}
        )

    return controller


@of_drives
def test_the_closed_loop_is_the_open_loop_with_the_same_commands_a_step_later(robot):
    robot = with_assumed(robot)
    twist = (0.4, 0.0, 0.0 if robot is SWERVE else 0.1)
    opened, closed = (drive(robot, twist, **options) for options in ({}, {"controller": follow(robot)}))
    assert opened.streams.keys() == closed.streams.keys()
    driven = robot.logged_wheels[0]
    names = {"speed_x_mps": 3e-3, "yaw_rate_radps": 3e-3, f"slip_{driven}_ratio": 0.01}
    for name, atol in names.items():
        late, early = (run.streams["truth"].channel(name)[200:] for run in (closed, opened))
        np.testing.assert_allclose(late, early, atol=atol, err_msg=name)


def test_an_antenna_moves_by_its_lever_arm():
    described = with_assumed(SKID).with_parts(antenna=Antenna(0.4, -0.2, 0.8))
    sharp = Gnss(latency_s=0.0, fix_std_m=1e-9, speed_std_mps=1e-9, fix_length_s=1e9)
    runs = [drive(r, (0.3, 0.0, 0.5), conditions=None, gnss=sharp) for r in (SKID, described)]
    plain, mounted = (run.streams["gnss"] for run in runs)
    truth = runs[1].streams["truth"]
    yaw, turn, roll_rad, pitch = (
        np.interp(mounted.time_s, truth.time_s, truth.channel(name))
        for name in ("yaw_rad", "yaw_rate_radps", "roll_rad", "pitch_rad")
    )
    x_m, y_m = 0.4 + 0.8 * np.sin(pitch), -0.2 - 0.8 * np.sin(roll_rad)
    east_m, north_m = x_m * np.cos(yaw) - y_m * np.sin(yaw), x_m * np.sin(yaw) + y_m * np.cos(yaw)
    about = mounted.values - plain.values
    np.testing.assert_allclose(about[:, :2], np.column_stack([east_m, north_m]), atol=2e-3)
    assert (
        np.abs((about[:, 2:4] - turn[:, None] * np.column_stack([-north_m, east_m])).mean(axis=0)).max()
        < 0.01
    )


@pytest.mark.parametrize("name", packaged("robots"))
def test_every_packaged_robot_has_the_streams_of_its_drive(name):
    robot = load_robot(name)
    options = {"gnss": Gnss(), "poses": Poses()}
    scenario = "complex" if robot.sideways else "survey"
    run, again = (simulate_run(name, "asphalt", scenario, 3, **options) for _ in range(2))
    assert {"wheels", "imu", "commands", "truth", "gnss", "pose"} <= run.streams.keys()
    assert ("steering" in run.streams) == robot.steered
    assert run.streams["wheels"].channels == (
        *robot.rate_channels,
        *(f"current_{wheel}_a" for wheel in robot.logged_wheels),
    )
    truth = run.streams["truth"]
    for wheel in robot.wheels:
        assert np.nanmax(np.abs(truth.channel(f"slip_{wheel}_ratio"))) <= 2.0
    for key, stream in run.streams.items():
        assert stream.values.tobytes() == again.streams[key].values.tobytes()
        assert key == "truth" or np.isfinite(stream.values).all()
    assert [label.terrain for label in run.labels] == ["asphalt"]
    speed = np.hypot(truth.channel("speed_x_mps"), truth.channel("speed_y_mps"))
    assert speed.max() > 0.1


def test_effects_and_instruments_from_outside_do_not_go_together():
    for options in ({"gnss": Gnss()}, {"poses": Poses()}):
        with pytest.raises(ConfigError, match="robot husky: with effects no receiver or pose is simulated"):
            simulate_run("husky", "grass", "straight", effects={"payload_ratio": 0.1}, **options)
