"""The dynamic plant: a robot of any drive, with load transfer on its contacts, in open loop or controlled.

A robot has wheels as its description has them, each with a motor or rolling freely, and contacts that they turn
(:mod:`terrain.simulation.contacts`): the two tyres of a side of a skid-steer robot turn at one rate, as do the patches
of a track, which are strips of it that together sink and shear as the whole; the two tyres of an axle of a car share
its torque and differ in rate by a differential, or roll freely, and those of a steered axle roll about one centre.

Effects of a swerve robot (:mod:`terrain.effects`) act where a real robot would have them:

- **wheel_radius, one_sided_radius**: true radii of the wheels, of which the commands know nothing;
- **steering_delay, steering_gain, steering_lag, steering_backlash, steering_offset_i**: between the encoder, which the
  steering motor obeys, and the wheel: ``wheel(t) = play(lag((1 + e) encoder(t - T))) + d0``;
- **force_slip, shear_slip**: a creep of the contact on top of the ground's own slip.  Its deflection follows ``du/dt
  = (w r - v) - max(|w r|, |v|) (u / sigma + c f)`` with ``f = 3 F_i / W``, so that it settles where slip is that of
  the ground plus ``c f``, and no equation has to be solved for a force; of a shear curve ``c f`` is bent as in
  :func:`shear_slip`, up to the wheel's own limit.  A negative creep leaves a tenth of the
  ground's slip: no contact is stiffer than ten times it;
- **side_hill_slip**: the ground goes by sideways: wheels roll without side force where they drift downhill by
  ``c ph |v|``;
- **rolling_resistance, slip_resistance, viscous_drag**: more resistance at each axle, by its load, its slip and its
  share of the speed; what is less than none is none.

How stiff a contact may be for the steps of the integration: beyond that it pushes the robot by itself.  A wheel of
inertia I and radius r on a contact of stiffness ``K = (dF/ds) / sigma``, with the deflection u, the relaxation length
sigma and the damping T, :data:`DEFLECTION_DAMPING_S`::

    F = K (u + T x)        x = w r - v        du/dt = x        dx/dt = -k u - k T x

with ``k = K (r^2 / I + 1 / m)`` and m the mass of the body.  :func:`step` steps the rate first, and the deflection
with the new rate::

    x' = x - dt k (u + T x)        u' = u + dt x'

The characteristic polynomial is ``z^2 - (2 - dt k T - dt^2 k) z + 1 - dt k T``.  By Jury's criterion its roots are
inside the unit circle where ``4 - 2 dt k T - dt^2 k > 0``, that is ``k < 4 / (dt (dt + 2 T))``.  The decay of the
deflection with the distance rolled only widens this.  Beyond the limit a wheel's rate changes its sign from step to
step and grows until the contact slides.  Its force then jumps between the friction limits of the load, which for a
large mass exceed what the motors can give by orders of magnitude.

The contacts share the body: the largest eigenvalue of all of them together is at most the largest of the wheels' own
(of a wheel with several contacts ``sum K_i r^2 / I``) plus the trace of the body's, ``sum K_i (2 / m + rho_i^2 /
I_z)``, with rho_i the distance of a wheel from the centre of mass.  A tyre as a spring k_t with a damper c under a
corner of mass m_i is stepped alike, and is stable where ``dt^2 k_t + 2 dt c < 4 m_i``.

States are integrated with semi-implicit steps of :data:`STEP_S`.  What acts, in the order of one step:

- **load**: contacts carry a rigid body: ``sum N = m g cos``, and the moments of gravity and inertia about the two body
  axes.  Of three contacts the normal forces follow from balance alone; more are springs of one stiffness each under a
  rigid body, so that theirs are the least squares of the balance.  Tyres as springs over a rough ground add their own;
  height, roll and pitch of the ride are those of the plane of least squares through the corners.
- **steering**: a rate-limited, acceleration-limited motor turns the wheel through a backlash of half width
  ``dead_band``.
- **speed loop** of each motor driver: PI on its own estimate of the wheel's rate, torque limit with
  anti-windup, torque lag; the current follows the torque.
- **contact**: longitudinal and lateral deflections of the contact (Pacejka, Tyre and Vehicle Dynamics, 7.2.1,
  single contact point) with the larger absolute speed as in the SAE slip,
  ``du/dt = (w r - v_long) - max(|w r|, |v_long|) u / sigma``, so that ``u / sigma`` settles at the slip
  ratio and stays finite at rest; ``terrain.terramechanics`` turns deflection and load into thrust, side force
  and resistance.  Where wheels are not steered, contacts skid: there the speed of the contact in any direction takes
  the place of that along the wheel, so that the force opposes the sliding whatever its direction.
- **rollers** of omni and mecanum wheels hold the ground along their axis alone, at the angle g to the direction d that
  the wheel drives along: ``du/dt = w r cos g - v_axis - max(|w r|, |v|) u / sigma``.  Across it they turn with
  ``v_across + w r sin g``, against a friction of ``roller_friction_ratio`` of the load times that speed over the
  larger of wheel speed and speed over ground; what resists rolling opposes the motion of the wheel in any direction.
- **differential**: with the inertia I of an axle, ``I dw/dt = T - r (F_l + F_r)`` for the mean rate w, and
  ``I dq/dt = r (F_l - F_r)`` for half the difference q of the rates of its tyres; T is 0 without a motor.
- **leg**: the third wheel's leg swings about a hinge on the line of the other two, within
  ``leg_backlash_rad``, to where the ground pushes its wheel; that turns the wheel's heading, which
  its steering encoder below the hinge does not see (thesis, conclusions: backlash of the third leg's opening
  system). What the swing moves the wheel's centre by, and its friction's own moment, are left out.
- **body**: ``m (dv/dt + w x v) = sum F - m g grad``, ``I dw/dt = sum (r_i - r_com) x F_i``.

Resistance acts at the axle, against the rolling of the wheel; hence in steady motion the thrust balances it
and the slip follows from the ground, not from the speed.

Roughness of waviness 2 is white in slope: ``d(road)/dt = -2 pi n_c v road + 2 pi n_0 sqrt(G v) w`` with ``w``
white of one-sided density 1 (ISO 8608); the contact averages it over its length.

**Runs.** With a controller the loop is closed: it gets what the sensors have written so far, and commands the wheels.
At instant ``t_k`` of the scenario the step that starts there has run with the command in force, so a sample stamped
``t_k`` of a sensor without latency is there; the command of the controller is in force from the step that starts a
delay later, one step at the least.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS, Stage, checked_effects, in_plant, on_samples, vector_of
from terrain.errors import ConfigError, DataError, LogError
from terrain.extension import apply_homes
from terrain.kernels import filled, inner, is_finite, njit, numbers, record
from terrain.kinematics.commands import wheel_motion
from terrain.kinematics.wheels import point_velocity, rolled_twist
from terrain.learned_term import INPUTS, Factor, rolling_change
from terrain.logs.schema import TWIST, unit_of
from terrain.records import Array, Command, Label, Sample, Stream, read_only
from terrain.robots import BicycleRobot, Robot, SwerveRobot, TrackedRobot
from terrain.simulation import sensors as sensing
from terrain.simulation.assumed import with_assumed
from terrain.simulation.contacts import TRACK_PATCHES, Contact, contacts_of
from terrain.simulation.scenario import Conditions, Faults, Scenario
from terrain.simulation.sensors import BODY_ROW, STEP_S, Gnss, Motion, Poses
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import GROUND, ground_record, rolling_resistance, wheel_ground

# Damping of the contact as a lead on its deflection; it vanishes in steady rolling and so moves no slip.
DEFLECTION_DAMPING_S = 0.005


FIELD_STEP_M = 0.1  # grid of the variation of the terrain along the path
# Cells of terrain up to the farthest point that the fastest wheel can reach; 24 h at 2 m/s take 3.5 million.
MAX_FIELD_CELLS = 5 * 10**6
MAX_DELAY_STEPS = 500  # steps of the longest delay of the steering, half a second
# Records have room for so many wheels and contacts: one compiled plant for all drives.
MAX_WHEELS = sensing.MAX_WHEELS
MAX_CONTACTS = 8
COUNTED_S = (
    0.005  # time constant of encoders without a low-pass of their own, whose steps are counted over some time
)
CONTACT_LIMIT_PS2 = 4.0 / (STEP_S * (STEP_S + 2.0 * DEFLECTION_DAMPING_S))  # largest stable ``k`` in 1/s^2
# Load transfer and rough ground load a wheel with up to so many times its share of the weight.
LOAD_MARGIN_RATIO = 2.0

# A contact that is stiffer than the steps allow, by so much at most, as those of small wheels are, relaxes over a
# longer distance: slip in steady motion is the same.
MAX_RELAXED = 5.0

_SMALL_SLIP = 1e-4

# A soil under the wheels, its ISO 8608 roughness, and the path length at which it begins, the first at 0.
PATCH = record({"ground": GROUND, **numbers("roughness_m3 roller_friction_ratio start_m")})

CONTACT = record(
    numbers(
        "x_m y_m radius_m roller_rad direction_rad side_ratio ackermann_m in_line_ratio load_fraction ride_ratio "
        "ride_roll_1pm ride_pitch_1pm"
    )
    | {"load_per_force_ratio": (float, 2), "wheel": int}
)
"""A contact with the ground of a wheel of the robot: its place and rolling radius; the axis of its rollers from the
direction that it drives along, and that direction where it is not steered; -1 or 1 for the left or right tyre behind a
differential; the wheelbase where an axle is steered, so that all its tyres roll about one centre; whether it follows
another; its share of the weight, and what a force along x or y of the body adds to it; what the ride of its corner is
of that of the body."""

PLANT = record(
    {
        "wheels_m": (float, (MAX_WHEELS, 2)),
        "wheel_direction_rad": (float, MAX_WHEELS),
        "wheel_roller_rad": (float, MAX_WHEELS),
        "driven": (bool, MAX_WHEELS),
        "radius_m": (float, MAX_WHEELS),
        "steer_offset_rad": (float, MAX_WHEELS),
        "contacts": (CONTACT, MAX_CONTACTS),
        "n_wheels": int,
        "n_contacts": int,
        "com_m": (float, 2),
        "grade_ratio": (float, 2),
        "rollers": bool,
        "skids": bool,
        "linked": bool,
        "yields": bool,
        "effects": EFFECTS,
        **numbers(
            "mass_kg weight_n com_height_m yaw_inertia_kgm2 wheel_inertia_kgm2 relaxation_length_m contact_length_m "
            "tyre_stiffness_npm tyre_damping_nspm torque_max_nm speed_max_radps torque_time_constant_s friction_nm "
            "speed_gain_nmspr speed_integral_nmpr speed_estimate_time_constant_s encoder_time_constant_s hall_steps "
            "rate_max_radps accel_max_radps2 dead_band_rad leg_backlash_rad undulation_ratio undulation_length_m"
        ),
    }
)
"""All numbers of one run that do not change while it is driven, by their names in the robot's description and in the
conditions; of wheels and contacts the first ones count; whether wheels have rollers, whether slip is over the speed in
any direction, whether effects act in the linkages of the steering and where wheels touch the ground; all effects."""

CONTACT_STATE = record(
    numbers(
        "deflection_x_m deflection_y_m ride_m ride_mps ride_mps2 road_m contact_m creep_ratio along_mps drift_mps "
        "fastest_mps"
    )
)
"""A contact; its creep is over the slip of the ground, and its speeds are those of the start of the step."""

WHEEL_STATE = record(
    numbers(
        "rate_radps spread_radps angle_rad steer_rad steer_motor_rad steer_motor_radps torque_nm integral_nm "
        "estimate_radps reported_radps hall_count heading_rad lagged_rad load_nm spread_nm"
    )
)
"""A wheel; its heading is that in the play of its linkage, its spread half of what the right tyre behind a differential
turns faster than the left one, and its loads are what the ground asks of it."""

STATE = record(
    numbers(
        "position_x_m position_y_m yaw_rad speed_x_mps speed_y_mps yaw_rate_radps path_m accel_x_mps2 "
        "drift_x_mps drift_y_mps drift_radps "
        "accel_y_mps2 leg_rad"
    )
    | {"wheels": (WHEEL_STATE, MAX_WHEELS), "contacts": (CONTACT_STATE, MAX_CONTACTS)}
    | {"n_steps": int, "late_rad": (float, (MAX_DELAY_STEPS, MAX_WHEELS))}
)
"""Position is that of the body's origin; speeds and accelerations (dv/dt + w x v, of the step before) are those of its
centre of mass in body axes; contacts drift by what was learned of the motion; the third leg is at 0 in the middle of
its play; ``late_rad`` are angles of the encoders that have not reached the wheels yet."""


class TerrainProfile(NamedTuple):
    """The terrain of one run along the path."""

    patches: Array  # (patches,) of :data:`PATCH`
    field: Array  # (2, contacts, cells) factors along the path on thrust and on resistance, for each contact


def draw_profile(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    conditions: Conditions,
    rng: np.random.Generator,
) -> TerrainProfile:
    """Return the terrain of a scenario, drawn as its soils and the conditions describe.

    Raises
    ------
    ConfigError
        if a terrain has no soil, or the robot gets too far to hold its terrain in memory.
    """
    for patch in scenario.patches:
        if patch.terrain not in soils:
            raise ConfigError(f"scenario {scenario.name}: terrain {patch.terrain!r} has no soil")
    used = [soils[patch.terrain] for patch in scenario.patches]
    start_m = np.array([patch.start_m for patch in scenario.patches])
    speed_max_radps = robot.motors.speed_max_radps
    farthest_m = 2.0 * robot.wheel_radius_m * speed_max_radps * scenario.time_s[-1]
    n_cells = math.ceil(farthest_m / FIELD_STEP_M) + 1
    if n_cells > MAX_FIELD_CELLS:
        raise ConfigError(
            f"robot {robot.name}: its wheels can come {farthest_m / 2e3:g} km far in this run, "
            f"{MAX_FIELD_CELLS * FIELD_STEP_M / 2e3:g} km of terrain are simulated at most"
        )
    keep = math.exp(-FIELD_STEP_M / conditions.field_length_m)
    white = rng.standard_normal((2, len(contacts_of(robot)), n_cells))
    white[:, :, 1:] *= math.sqrt(1.0 - keep**2)
    unit = lfilter([1.0], [1.0, -keep], white, axis=2)
    patch_of_cell = np.searchsorted(start_m, np.arange(n_cells) * FIELD_STEP_M, side="right") - 1
    ratios = np.array([soil.field_ratios() for soil in used])
    spread = ratios[patch_of_cell].T
    field = np.exp(spread[:, None, :] * unit - 0.5 * spread[:, None, :] ** 2)
    roughness = [soil.roughness_m3 * conditions.roughness_factor for soil in used]
    return TerrainProfile(patches_on(robot, used, roughness, start_m), field)


def patches_on(
    robot: Robot, soils: Sequence[Soil], roughness_m3: Sequence[float], start_m: Sequence[float] | Array
) -> Array:
    """Return soils under the wheels of a robot, with their roughness and starts, (soils,) of :data:`PATCH`."""
    body, patches = robot.body, np.zeros(len(soils), PATCH)
    wheel: Any = robot.wheel_radius_m, body.tyre_width_m, body.contact_length_m
    if isinstance(robot, TrackedRobot):
        wheel = robot.wheel_radius_m, robot.track_width_m, robot.contact_length_m, TRACK_PATCHES
    for patch, soil in zip(patches, soils, strict=True):
        (patch["ground"],) = ground_record(soil, *wheel)
        patch["roller_friction_ratio"] = np.nan_to_num(soil.roller_friction_ratio)
    patches["roughness_m3"], patches["start_m"] = roughness_m3, start_m
    return patches


def make_plant(robot: Robot, conditions: Conditions) -> Array:
    """Return the plant of a robot with all sections and its load, (1,) of :data:`PLANT`.

    Raises
    ------
    ConfigError
        if the load takes the centre of mass out of the area between the contacts.
    """
    body, motors, sensors = robot.body, robot.motors, robot.sensors
    steering = [robot.steering] if robot.steered else []
    parts = (*steering, body, motors, sensors, conditions)  # a torque is that of the motors
    described = {n: getattr(part, n) for part in parts for n in PLANT.names or () if hasattr(part, n)}
    effects = defaultdict(float, robot.effects)
    mass_kg = robot.mass_kg * (1.0 + effects["payload_ratio"]) + conditions.payload_kg
    n, half = len(robot.wheels), 0.5 * effects["one_sided_radius_ratio"]
    rolling = (1.0 + effects["wheel_radius_ratio"]) * np.array([*[1.0 - half] * (n - 1), 1.0 + half])
    factors = np.array([*conditions.radius_factors, *[1.0] * n][:n])
    offset_m = conditions.payload_kg / mass_kg * np.asarray(conditions.payload_m)
    com_m = np.array([body.com_x_m, body.com_y_m]) + offset_m
    # Rows: vertical force, moment about y (x arm), moment about x (y arm); columns: the contacts.  Of more than three
    # the springs under a rigid body give the loads: those of least squares.
    places = contacts_of(robot)
    balance = np.array([[1.0, place.x_m, place.y_m] for place in places]).T
    inverse = np.linalg.inv(balance) if len(places) == 3 else np.linalg.pinv(balance)
    load_fraction = inverse @ np.array([1.0, com_m[0], com_m[1]])
    if load_fraction.min() <= 0.0:
        (x_m, y_m), what = com_m - offset_m, "its centre of mass"
        if conditions.payload_kg:
            (x_m, y_m), what = (
                conditions.payload_m,
                f"a payload of {conditions.payload_kg:g} kg, beside its centre of mass",
            )
        raise ConfigError(
            f"robot {robot.name}: {what} at ({x_m:g}, {y_m:g}) m tips it over: wheel "
            f"{places[int(load_fraction.argmin())].wheel + 1} would carry nothing"
        )
    wheels: dict[str, Any] = {
        "wheels_m": robot.wheel_positions_m,
        "wheel_direction_rad": robot.wheel_directions_rad,
        "wheel_roller_rad": robot.roller_angles_rad,
        "radius_m": robot.wheel_radius_m * factors * rolling,
        "driven": np.isin(robot.wheels, robot.logged_wheels),
        "steer_offset_rad": [effects[f"steering_offset_{i + 1}_rad"] for i in range(n)],
    }
    of_robot = {
        "com_m": com_m,
        "n_wheels": n,
        "n_contacts": len(places),
        "rollers": robot.on_omni_wheels,
        "skids": not robot.steered,
        "mass_kg": mass_kg,
        "weight_n": robot.mass_kg * GRAVITY_MPS2,
        "yaw_inertia_kgm2": body.yaw_inertia_kgm2 * mass_kg / robot.mass_kg,
        "encoder_time_constant_s": max(sensors.encoder_time_constant_s, COUNTED_S),
        "leg_backlash_rad": conditions.leg_backlash_rad if isinstance(robot, SwerveRobot) else 0.0,
        "hall_steps": sensors.hall_steps_ratio * motors.reduction_ratio / (2 * math.pi),
        "linked": any(effects[name] != 0.0 for name in in_plant(Stage.LINKAGE)),
        "yields": any(effects[name] != 0.0 for name in in_plant(Stage.CONTACT)),
        "effects": vector_of(robot.effects).view(EFFECTS),
    }
    plant = filled(PLANT, **(described | of_robot))
    for name, values in wheels.items():
        plant[name][0, :n] = values
    for contact, place, (ride, ride_pitch, ride_roll), load in zip(
        plant["contacts"][0], places, inverse, load_fraction, strict=False
    ):
        contact["load_per_force_ratio"] = -body.com_height_m * np.array([ride_pitch, ride_roll])
        for name in Contact._fields:
            contact[name] = getattr(place, name)
        for name in ("radius_m", "direction_rad", "roller_rad"):
            contact[name] = wheels["radius_m" if name == "radius_m" else f"wheel_{name}"][place.wheel]
        contact["load_fraction"], contact["ride_ratio"] = load, ride
        contact["ride_roll_1pm"], contact["ride_pitch_1pm"] = ride_roll, -ride_pitch
    return plant


def start_state(steer_rad: Array) -> Array:
    """Return the state, (1,) of :data:`STATE`, of a robot at rest at the origin, its steering motors at 0.

    Its wheels hang in their play at ``steer_rad`` (wheels,).
    """
    state, n = filled(STATE), len(steer_rad)
    for name in ("steer_rad", "heading_rad", "lagged_rad"):
        state["wheels"][name][0, :n] = steer_rad
    state["late_rad"][0, :, :n] = steer_rad
    return state


def contact_stiffness(plant: Array, profile: TerrainProfile) -> float:
    """Return how stiff contacts are under its weight on its stiffest ground over what the steps allow.

    With :data:`LOAD_MARGIN_RATIO`.
    """
    robot, mass_kg = plant[0], float(plant["mass_kg"][0])
    contacts = robot["contacts"][: robot["n_contacts"]]
    load_n = mass_kg * GRAVITY_MPS2 * contacts["load_fraction"]
    spin = contacts["radius_m"] ** 2 / robot["wheel_inertia_kgm2"]
    arm_m2 = (contacts["x_m"] - robot["com_m"][0]) ** 2 + (contacts["y_m"] - robot["com_m"][1]) ** 2
    body, rates_ps2 = 2.0 / mass_kg + arm_m2 / robot["yaw_inertia_kgm2"], []
    for ground in profile.patches["ground"]:  # the thrust over its slip is steepest at the start of the curve
        slope_n = np.array([wheel_ground(ground, load, _SMALL_SLIP, 0.0)[0] for load in load_n]) / _SMALL_SLIP
        stiffness_npm = slope_n / robot["relaxation_length_m"]
        wheels = np.bincount(contacts["wheel"], stiffness_npm * spin)  # contacts of a wheel push it together
        rates_ps2.append(wheels.max() + (stiffness_npm * body).sum())
    return LOAD_MARGIN_RATIO * float(np.max(rates_ps2)) / CONTACT_LIMIT_PS2


def check_step(plant: Array, profile: TerrainProfile, name: str) -> None:
    """Refuse a robot on its terrain whose contacts or tyres are too stiff for the steps of the integration.

    Raises
    ------
    ConfigError
        if the contacts, as :func:`contact_stiffness` has them, or the tyres are beyond their limit, or not finite.
    """
    robot, mass_kg = plant[0], float(plant["mass_kg"][0])
    contacts, contact = robot["contacts"][: robot["n_contacts"]], contact_stiffness(plant, profile)
    damped = STEP_S * robot["tyre_stiffness_npm"] + 2.0 * robot["tyre_damping_nspm"]
    tyre = STEP_S * damped / 4.0 / (mass_kg * float(contacts["load_fraction"].min()))
    steps = f"robot {name}: its motion cannot be integrated in steps of {STEP_S:g} s: "
    if not contact <= 1.0:
        raise ConfigError(
            f"{steps}under {mass_kg:g} kg the contacts are {contact:.3g} times too stiff for the "
            "inertia of wheels and yaw; reduce mass or load, or raise these inertias"
        )
    if not tyre <= 1.0:
        raise ConfigError(
            f"{steps}with {mass_kg:g} kg the tyres are {tyre:.3g} times too stiff or too damped; raise "
            "the mass, or reduce their stiffness and damping"
        )


# Speed over which a resistance takes its full size: it opposes rolling and does not push a robot at rest.
ROLLING_SPEED_MPS = 0.02
# How fast the third leg swings through its play; assumed, it crosses one degree in 35 ms.
LEG_RATE_RADPS = 0.5
# Moment about its hinge below which the third leg stays where it is; assumed, 7 N on the wheel: a start at 1 m/s^2
# gives three times as much, steady rolling less.
LEG_FRICTION_NM = 5.0
LEAST_CREEP = -0.9  # least creep over the slip of the ground
ROUGHNESS_WAVENUMBER = 0.1  # reference wave number of ISO 8608 in cycles/m
ROUGHNESS_CUTOFF = 0.01  # longest wave that counts as roughness, in cycles/m (ISO 8608's lower end)


def settle(plant: Array, profile: TerrainProfile, state: Array) -> None:
    """Let a robot that was put on a slope come to rest; ``state`` is changed in place.

    Its wheels are commanded to stand; contacts and motors take up the load, which on the level changes
    nothing. For four of five seconds the speeds are taken away ten times a second, so that it does not swing;
    where it rests afterwards is the origin.  Terrain too steep to stand on lets it slide.
    """
    still, rows = np.zeros((100, plant["n_contacts"][0])), np.empty(100, BODY_ROW)
    for tenth in range(50):
        advance(plant, profile, state, still, still, still, rows)
        if tenth < 40:
            state["speed_x_mps"] = state["speed_y_mps"] = state["yaw_rate_radps"] = 0.0
    for name in ("position_x_m", "position_y_m", "yaw_rad", "path_m"):
        state[name] = 0.0


@njit
def advance(
    plant: Array,
    profile: TerrainProfile,
    state: Array,
    wheel_radps: Array,
    steer_rad: Array,
    road_noise: Array,
    rows: Array,
) -> None:
    """Drive through the commands of each step of :data:`STEP_S`; ``state`` is changed in place.

    Parameters
    ----------
    plant, profile, state : as :func:`make_plant`, :func:`draw_profile` and :func:`start_state` give them; or a state as
        an earlier call left it
    wheel_radps, steer_rad : (n, wheels) commands
    road_noise : (n, contacts) standard normal numbers, the roughness under each contact
    rows : (n,) of :data:`~terrain.simulation.sensors.BODY_ROW`, is written
    """
    for k in range(rows.size):
        step(plant[0], profile, state[0], wheel_radps[k], steer_rad[k], road_noise[k], rows[k], STEP_S)


@inner
def step(
    plant: Any,
    profile: TerrainProfile,
    state: Any,
    wheel_radps: Array,
    steer_rad: Array,
    noise: Array,
    row: Any,
    dt: float,
) -> None:
    """Step all wheels, then the body that they carry; the row is that of the start of the step."""
    # the gradient of the ground in body axes, uphill positive
    cos_yaw, sin_yaw = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
    undulation = plant.undulation_ratio * math.sin(2 * math.pi * state.path_m / plant.undulation_length_m)
    world_x, world_y = plant.grade_ratio[0] + undulation, plant.grade_ratio[1]
    grade_x, grade_y = cos_yaw * world_x + sin_yaw * world_y, -sin_yaw * world_x + cos_yaw * world_y
    steepness = math.sqrt(1.0 + grade_x * grade_x + grade_y * grade_y)
    row.grade_x_ratio, row.grade_y_ratio = grade_x, grade_y
    force_x, force_y, moment, leg_nm = 0.0, 0.0, 0.0, 0.0
    com_x, com_y, sigma_m = plant.com_m[0], plant.com_m[1], plant.relaxation_length_m
    cell = min(max(int(state.path_m / FIELD_STEP_M), 0), profile.field.shape[2] - 1)  # a NaN is no place
    for i in range(plant.n_wheels):
        w, out, radius_m = state.wheels[i], row.wheels[i], plant.radius_m[i]
        _steer_wheel(plant, w, steer_rad[i], dt)
        heading = row.encoder_rad[i] = w.steer_rad
        if plant.linked:  # delay, gain, lag, play and offset of its linkage
            late, play = w.steer_rad, plant.effects.steering_backlash_rad
            delay_steps = round(plant.effects.steering_delay_s / dt)
            if delay_steps > 0:
                place = state.n_steps % delay_steps
                late, state.late_rad[place, i] = state.late_rad[place, i], w.steer_rad
            tau_s, late = plant.effects.steering_lag_s, (1.0 + plant.effects.steering_gain_ratio) * late
            w.lagged_rad += (1.0 - math.exp(-dt / tau_s) if tau_s > 0.0 else 1.0) * (late - w.lagged_rad)
            late = w.lagged_rad
            w.heading_rad = min(max(w.heading_rad, late - play), late + play)
            heading = w.heading_rad + plant.steer_offset_rad[i]
        if i == 2 and plant.leg_backlash_rad > 0.0:
            heading += state.leg_rad
        x_m, y_m = plant.wheels_m[i, 0] - com_x, plant.wheels_m[i, 1] - com_y
        v_x, v_y = point_velocity(state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps, x_m, y_m)
        roller = plant.wheel_roller_rad[i]
        axis = heading + plant.wheel_direction_rad[i] + roller
        cos, sin, wheel_speed = math.cos(axis), math.sin(axis), w.rate_radps * radius_m
        along, across = cos * v_x + sin * v_y, -sin * v_x + cos * v_y
        along /= math.cos(roller)  # the speed at which the wheel would roll without slip (terrain.slip)
        fastest = max(abs(wheel_speed), abs(along))
        out.wheel_radps, out.steer_rad = wheel_speed / radius_m, heading  # of this instant, as the slip is
        out.slip_ratio = (wheel_speed - along) / fastest if fastest >= 0.05 else np.nan
        out.slip_angle_rad = math.atan2(across, abs(along)) if math.hypot(along, across) >= 0.05 else np.nan
        out.normal_n = out.traction_n = out.side_n = out.sinkage_m = w.load_nm = w.spread_nm = 0.0
        out.patch_ratio = -1.0
    for c in range(plant.n_contacts):
        at, t = plant.contacts[c], state.contacts[c]
        i = at.wheel
        w, out, radius_m = state.wheels[i], row.wheels[i], at.radius_m
        heading = out.steer_rad
        if at.ackermann_m > 0.0:  # all tyres of the axle roll about one centre
            about_m = at.ackermann_m * math.cos(heading) - at.y_m * math.sin(heading)
            heading = math.atan2(at.ackermann_m * math.sin(heading), about_m)
        heading += at.direction_rad + at.roller_rad
        # speed of the contact, along the wheel and across it, or along the axis of its rollers and across that
        x_m, y_m = at.x_m - com_x, at.y_m - com_y
        v_x, v_y = point_velocity(state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps, x_m, y_m)
        cos_steer, sin_steer = math.cos(heading), math.sin(heading)
        along = cos_steer * v_x + sin_steer * v_y
        across = -sin_steer * v_x + cos_steer * v_y
        drift_x = state.drift_x_mps - at.y_m * state.drift_radps
        drift_y = state.drift_y_mps + at.x_m * state.drift_radps
        drift_along = cos_steer * drift_x + sin_steer * drift_y
        wheel_speed = (w.rate_radps + at.side_ratio * w.spread_radps) * radius_m
        cos_roller, sin_roller = math.cos(at.roller_rad), math.sin(at.roller_rad)
        pulled = wheel_speed * cos_roller
        fastest = max(abs(wheel_speed), math.hypot(along, across) if plant.skids else abs(along))
        # the patch that the contact is on lies ahead of the body's by its place in the direction of motion
        speed = (
            math.sqrt(state.speed_x_mps * state.speed_x_mps + state.speed_y_mps * state.speed_y_mps) + 1e-9
        )
        ahead_m = (at.x_m * state.speed_x_mps + at.y_m * state.speed_y_mps) / speed
        at_m, patch = state.path_m + (ahead_m if speed > 0.05 else 0.0), 0
        while patch + 1 < profile.patches.size and at_m >= profile.patches[patch + 1].start_m:
            patch += 1
        ground = profile.patches[patch].ground
        rolled = math.sqrt(along * along + across * across)
        ride_n = _ride_over(plant, at, t, profile.patches[patch].roughness_m3, rolled, noise[c], dt)
        normal_n = plant.mass_kg * (
            GRAVITY_MPS2 / steepness * at.load_fraction
            + at.load_per_force_ratio[0] * (state.accel_x_mps2 + GRAVITY_MPS2 * grade_x / steepness)
            + at.load_per_force_ratio[1] * (state.accel_y_mps2 + GRAVITY_MPS2 * grade_y / steepness)
        )
        t.ride_mps2 = ride_n / (plant.mass_kg * at.load_fraction)
        normal_n = max(normal_n + ride_n, 0.0)
        rate_x = pulled - along + drift_along - fastest / sigma_m * t.deflection_x_m
        rate_y = cos_steer * drift_y - sin_steer * drift_x - across - fastest / sigma_m * t.deflection_y_m
        if plant.yields:
            rate_x -= t.creep_ratio * fastest / sigma_m * t.deflection_x_m
            rate_y -= plant.effects.side_hill_slip_ratio * math.atan(grade_y) * abs(along)
        slip_x = (t.deflection_x_m + DEFLECTION_DAMPING_S * rate_x) / sigma_m
        slip_y = (t.deflection_y_m + DEFLECTION_DAMPING_S * rate_y) / sigma_m
        if plant.rollers:  # they turn freely across their axis, against their own friction
            turning = across + wheel_speed * sin_roller
            slip_y = 0.0
        thrust, side, resistance, sinkage = wheel_ground(
            ground, normal_n, min(max(slip_x, -1.0), 1.0), slip_y
        )
        if at.in_line_ratio * along > 0.0:  # the rut is there
            resistance = rolling_resistance(normal_n, ground.rolling_resistance_ratio)
        thrust *= profile.field[0, c, cell]
        side *= profile.field[0, c, cell]
        resistance *= profile.field[1, c, cell]
        if plant.rollers:
            friction = profile.patches[patch].roller_friction_ratio * normal_n
            side = -friction * turning / max(fastest, ROLLING_SPEED_MPS)
        if plant.yields:
            t.creep_ratio = _creep(plant, ground, normal_n, slip_x, thrust)
            slip = abs(slip_x) * (1.0 + t.creep_ratio)
            more = plant.effects.rolling_resistance_ratio + plant.effects.slip_resistance_ratio * slip
            resistance += more * normal_n
            resistance = max(resistance + plant.effects.viscous_drag_nspm * abs(along) / 3.0, 0.0)
        # what resists acts at the axle, against the rolling of the wheel, or of the wheel and its rollers
        traction, aside = thrust * cos_roller - side * sin_roller, thrust * sin_roller + side * cos_roller
        pull, side_n = thrust - resistance * math.tanh(along / ROLLING_SPEED_MPS), side
        if plant.rollers and rolled > 0.0:
            against = resistance * math.tanh(rolled / ROLLING_SPEED_MPS) / rolled
            pull, side_n = thrust - against * along, side - against * across
        w.load_nm += traction * radius_m
        w.spread_nm += at.side_ratio * traction * radius_m
        t.along_mps, t.drift_mps, t.fastest_mps = along, drift_along, fastest
        t.deflection_y_m = min(max(t.deflection_y_m + dt * rate_y, -sigma_m), sigma_m)
        out.normal_n += normal_n
        out.traction_n += traction
        out.side_n += aside
        out.sinkage_m = max(out.sinkage_m, sinkage)
        # of a wheel on two grounds none is the terrain
        out.patch_ratio = patch if out.patch_ratio == -1.0 or out.patch_ratio == patch else -2.0
        f_x, f_y = cos_steer * pull - sin_steer * side_n, sin_steer * pull + cos_steer * side_n
        if i == 2:
            leg_nm = -at.y_m * f_x
        force_x += f_x
        force_y += f_y
        moment += x_m * f_y - y_m * f_x
    for i in range(plant.n_wheels):
        w, out = state.wheels[i], row.wheels[i]
        _drive_wheel(plant, w, plant.driven[i] != 0, wheel_radps[i], dt)
        out.torque_nm, out.reported_radps = w.torque_nm, w.reported_radps
    for c in range(plant.n_contacts):
        # the contact follows with the wheel's new rate: semi-implicit
        at, t = plant.contacts[c], state.contacts[c]
        w = state.wheels[at.wheel]
        wheel_speed = (w.rate_radps + at.side_ratio * w.spread_radps) * at.radius_m * math.cos(at.roller_rad)
        decay = t.fastest_mps / sigma_m
        deflection = t.deflection_x_m + dt * (
            wheel_speed - t.along_mps + t.drift_mps - decay * t.deflection_x_m
        )
        if plant.yields:  # implicit: a contact that creeps fast is stiff
            deflection /= 1.0 + dt * (t.creep_ratio * decay)
        t.deflection_x_m = min(max(deflection, -sigma_m), sigma_m)
    state.n_steps += 1
    accel_x = force_x / plant.mass_kg - GRAVITY_MPS2 * grade_x / steepness
    accel_y = force_y / plant.mass_kg - GRAVITY_MPS2 * grade_y / steepness
    spin, turn = moment / plant.yaw_inertia_kgm2, state.yaw_rate_radps
    # speeds and accelerations at the origin; the ride of the plane through the corners
    row.position_x_m, row.position_y_m, row.yaw_rad = state.position_x_m, state.position_y_m, state.yaw_rad
    row.speed_x_mps, row.speed_y_mps = point_velocity(
        state.speed_x_mps, state.speed_y_mps, turn, -com_x, -com_y
    )
    row.yaw_rate_radps = turn
    row.accel_x_mps2 = accel_x + spin * com_y + turn * turn * com_x
    row.accel_y_mps2 = accel_y - spin * com_x + turn * turn * com_y
    row.ride_z_mps2 = row.ride_roll_rad = row.ride_pitch_rad = row.ride_roll_radps2 = (
        row.ride_pitch_radps2
    ) = 0.0
    for c in range(plant.n_contacts):
        at, t = plant.contacts[c], state.contacts[c]
        row.ride_z_mps2 += at.ride_ratio * t.ride_mps2
        row.ride_roll_rad += at.ride_roll_1pm * t.ride_m
        row.ride_pitch_rad += at.ride_pitch_1pm * t.ride_m
        row.ride_roll_radps2 += at.ride_roll_1pm * t.ride_mps2
        row.ride_pitch_radps2 += at.ride_pitch_1pm * t.ride_mps2
    row.path_m, row.leg_rad = state.path_m, state.leg_rad
    # step the body with the acceleration of its centre of mass and of its yaw
    vx, vy = state.speed_x_mps, state.speed_y_mps
    state.speed_x_mps = vx + dt * (accel_x + turn * vy)
    state.speed_y_mps = vy + dt * (accel_y - turn * vx)
    state.yaw_rate_radps = turn + dt * spin
    origin_x, origin_y = point_velocity(
        state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps, -com_x, -com_y
    )
    state.position_x_m += dt * (cos_yaw * origin_x - sin_yaw * origin_y)
    state.position_y_m += dt * (sin_yaw * origin_x + cos_yaw * origin_y)
    state.yaw_rad += dt * state.yaw_rate_radps
    state.path_m += dt * math.sqrt(origin_x * origin_x + origin_y * origin_y)
    state.accel_x_mps2, state.accel_y_mps2 = accel_x, accel_y
    if plant.leg_backlash_rad > 0.0 and abs(leg_nm) > LEG_FRICTION_NM:
        # the third leg swings through its play to where its wheel is pushed, if that is hard enough
        leg_rad = state.leg_rad + math.copysign(LEG_RATE_RADPS * dt, leg_nm)
        state.leg_rad = min(max(leg_rad, -plant.leg_backlash_rad), plant.leg_backlash_rad)


@njit
def shear_slip(force_ratio: float, grip_ratio: float) -> float:
    """Return the slip of a shear curve whose slip per force is 1 at the start; its end at 95 % of the grip.

    ``f/f_max = 1 - (1 - exp(-x))/x`` is solved for ``x``, and ``s = x f_max / 2``: ``x = 2 f/f_max`` for
    small forces.

    Examples
    --------
    >>> round(shear_slip(0.001, 0.5), 5), round(shear_slip(0.25, 0.5), 3)
    (0.001, 0.398)
    """
    part = min(abs(force_ratio) / grip_ratio, 0.95)
    if part < 1e-9:
        return force_ratio
    # start from the two ends' forms, then Newton
    x = 2.0 * part + part * part * part / (1.0 - part)
    for _ in range(6):
        e = math.exp(-x)
        value = 1.0 - (1.0 - e) / x - part if x > 1e-4 else 0.5 * x - x * x / 6.0 - part
        slope = (1.0 - e - x * e) / (x * x) if x > 1e-4 else 0.5 - x / 3.0
        x = max(x - value / slope, 1e-9)
    return math.copysign(0.5 * grip_ratio * x, force_ratio)


@inner
def _creep(plant: Any, ground: Any, normal_n: float, slip: float, thrust_n: float) -> float:
    """Return what a contact creeps by beside the slip of the ground, over that slip."""
    if abs(slip) < 1e-6 or normal_n <= 0.0:
        return 0.0
    force_ratio = 3.0 * thrust_n / plant.weight_n
    creep = plant.effects.force_slip_ratio * force_ratio
    if plant.effects.shear_slip_ratio != 0.0:
        grip_ratio = ground.peak_friction_ratio
        if not ground.hard:
            area_m2 = ground.contact_length_m * ground.tyre_width_m
            grip_ratio = ground.tan_friction + ground.cohesion_pa * area_m2 / normal_n
        creep += plant.effects.shear_slip_ratio * shear_slip(force_ratio, grip_ratio)
    return float(max(creep / slip, LEAST_CREEP))


@inner
def _ride_over(
    plant: Any, at: Any, t: Any, roughness_m3: float, speed: float, noise: float, dt: float
) -> float:
    """Move the corner on its tyre over the rough ground; return what that adds to the load."""
    white = noise * math.sqrt(0.5 / dt)
    t.road_m += dt * (
        -2 * math.pi * ROUGHNESS_CUTOFF * speed * t.road_m
        + 2 * math.pi * ROUGHNESS_WAVENUMBER * math.sqrt(roughness_m3 * speed) * white
    )
    contact_rate = (t.road_m - t.contact_m) * min(2.0 * speed / plant.contact_length_m, 1.0 / dt)
    t.contact_m += dt * contact_rate
    mass_kg = plant.mass_kg * at.load_fraction
    force_n = plant.tyre_stiffness_npm * (t.contact_m - t.ride_m) + plant.tyre_damping_nspm * (
        contact_rate - t.ride_mps
    )
    t.ride_mps += dt * force_n / mass_kg
    t.ride_m += dt * t.ride_mps
    return float(force_n)


@inner
def _steer_wheel(plant: Any, w: Any, command_rad: float, dt: float) -> None:
    """Steering motor to its command with bounded rate and acceleration; the wheel hangs on it with play."""
    error = command_rad - w.steer_motor_rad
    # the rate from which the motor can still stop in time
    desired = math.copysign(
        min(math.sqrt(2 * plant.accel_max_radps2 * abs(error)), plant.rate_max_radps), error
    )
    if abs(error) < 1e-4:
        desired = error / dt
    change = plant.accel_max_radps2 * dt
    w.steer_motor_radps += min(max(desired - w.steer_motor_radps, -change), change)
    w.steer_motor_rad += dt * w.steer_motor_radps
    w.steer_rad = min(
        max(w.steer_rad, w.steer_motor_rad - plant.dead_band_rad), w.steer_motor_rad + plant.dead_band_rad
    )


@inner
def _drive_wheel(plant: Any, w: Any, driven: bool, command_radps: float, dt: float) -> None:
    """Speed loop, motor and wheel; then the rate that the motor driver reports."""
    command = min(max(command_radps, -plant.speed_max_radps), plant.speed_max_radps)
    error = command - w.estimate_radps
    desired = plant.speed_gain_nmspr * error + w.integral_nm
    torque = min(max(desired, -plant.torque_max_nm), plant.torque_max_nm)
    if torque == desired or desired * error < 0.0:
        w.integral_nm += dt * plant.speed_integral_nmpr * error
    w.torque_nm += (torque - w.torque_nm) * min(dt / max(plant.torque_time_constant_s, dt), 1.0)
    friction = plant.friction_nm * math.tanh(w.rate_radps / 0.1)
    if not driven:
        w.torque_nm = w.integral_nm = friction = 0.0
    w.rate_radps += dt * (w.torque_nm - friction - w.load_nm) / plant.wheel_inertia_kgm2
    w.spread_radps -= dt * w.spread_nm / plant.wheel_inertia_kgm2
    w.angle_rad += dt * w.rate_radps
    lag = min(dt / max(plant.speed_estimate_time_constant_s, dt), 1.0)
    w.estimate_radps += (w.rate_radps - w.estimate_radps) * lag
    count = math.floor(w.angle_rad * plant.hall_steps)
    seen = (count - w.hall_count) / plant.hall_steps / dt
    w.hall_count = count
    w.reported_radps += (seen - w.reported_radps) * min(dt / max(plant.encoder_time_constant_s, dt), 1.0)


MIN_LABEL_S = 0.5  # A shorter stay on one ground gets no label
# No wheel turns so many times as fast as its motor can: then the steps are too long for the robot, as with a load
# of 1000 t on 90 kg.
MAX_WHEEL_SPEEDS = 100.0
MAX_COMMAND_DELAY_S = 0.5  # longest delay of a command to the wheels; a later one is no control

_PURPOSES = ("terrain", "road", "start", "wheels", "steering", "imu", "camera", "gnss", "pose", "compass")


def run_dynamic(
    robot: Robot,
    scenario: Scenario,
    soils: Mapping[str, Soil],
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    faults: Faults,
    effects: Mapping[str, float],
    gnss: Gnss | None = None,
    poses: Poses | None = None,
    compass: bool = False,
    controller: Callable[[Sample], Command] | None = None,
    command_delay_s: float = 0.0,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a scenario, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Parameters
    ----------
    robot : of any drive; sections that it lacks are those of :func:`~terrain.simulation.assumed.with_assumed`
    soils : by the terrain names of the scenario
    gnss, poses : receiver on board, and what sees its pose from outside, if any
    compass : whether a compass shows its heading, ten times a second
    controller : called once an instant of the scenario with the samples that arrived since the instant before, as the
        log has them; before its first command is in force, the wheels are commanded to stand and the steering to stay
        at 0.  Without one the wheels are commanded to follow the desired twists
    command_delay_s : from that instant to when the command is in force, in whole steps, one at least
    """
    robot = with_assumed(robot)
    if not isinstance(robot, SwerveRobot) and (effects or robot.effects or robot.learned):
        raise ConfigError(
            f"robot {robot.name}: effects and learned terms of the drive {robot.drive!r} act on a planar ground, not "
            "on soils"
        )
    substeps = round(1 / (scenario.rate_hz * STEP_S))
    if abs(substeps * scenario.rate_hz * STEP_S - 1.0) > 1e-9:
        raise ConfigError(
            f"scenario {scenario.name}: rate_hz is {scenario.rate_hz:g}, it must divide {1 / STEP_S:g}"
        )
    for section in ("camera", "sensors"):
        on_board = robot.parts.get(section)
        for name in ("rate_hz", "wheels_rate_hz", "steering_rate_hz", "imu_rate_hz"):
            if getattr(on_board, name, 0.0) > 1 / STEP_S:
                raise ConfigError(
                    f"robot {robot.name}: {section}: {name} is {getattr(on_board, name):g}, "
                    f"at most {1 / STEP_S:g} is simulated"
                )
    is_number = isinstance(command_delay_s, int | float | np.integer | np.floating)
    if not is_number or isinstance(command_delay_s, bool) or not 0 <= command_delay_s <= MAX_COMMAND_DELAY_S:
        raise ConfigError(
            f"command_delay_s is {command_delay_s!r}, a time from 0 to {MAX_COMMAND_DELAY_S:g} s is required"
        )
    rngs, built = sensing.generators(seed, _PURPOSES), robot
    if robot.effects or effects:  # with all its effects, of which the commanded one lacks some
        acting = checked_effects("effects", {**robot.effects, **effects}, robot.drive)
        built = replace(robot, effects=acting, effects_cov=np.full((len(acting), len(acting)), np.nan))
        built = apply_homes(built, in_plant(Stage.DESCRIPTION))
    profile = draw_profile(built, scenario, soils, conditions, rngs["terrain"])
    plant = make_plant(built, conditions)
    stiff = contact_stiffness(plant, profile)
    if 1.0 < stiff <= MAX_RELAXED:
        plant["relaxation_length_m"] *= 1.001 * stiff  # beyond rounding
    check_step(plant, profile, built.name)
    n_steps = len(scenario.time_s) * substeps
    n_wheels, n_contacts = len(robot.wheels), int(plant["n_contacts"][0])
    of_wheels, of_steer = slice(3, 3 + n_wheels), slice(3 + n_wheels, None)  # of a row of commands
    state = start_state(plant["dead_band_rad"][0] * rngs["start"].uniform(-1.0, 1.0, n_wheels))
    settle(plant, profile, state)
    road_noise = rngs["road"].standard_normal((n_steps, n_contacts))
    motion = Motion(np.empty(n_steps, BODY_ROW), 0)
    rows = motion.record
    imu, gyro_bias_radps = sensing.imu_sensor(motion, built, rngs["imu"])
    sensors = {"wheels": sensing.wheel_sensor(motion, built, rngs["wheels"])}
    if robot.steered:
        sensors["steering"] = sensing.steering_sensor(motion, built, rngs["steering"])
    sensors["imu"] = imu
    if robot.describes("camera") and not robot.on_omni_wheels:
        sensors["odometry"] = sensing.camera_sensor(motion, built, rngs["camera"], faults)
    if gnss is not None:
        sensors["gnss"] = sensing.gnss_sensor(motion, built, gnss, rngs["gnss"])
    if poses is not None:
        sensors["pose"] = sensing.pose_sensor(motion, poses, rngs["pose"], faults)
    if compass:
        sensors["compass"] = sensing.compass_sensor(motion, rngs["compass"])
    for name, sensor in sensors.items():
        stamped = on_samples(name, (), built.effects)(sensor.time_s.copy(), sensor.values)
        sensor.stamp_s = read_only(stamped[0])

    status: list[Mapping[str, float]] = []
    lags: list[dict[Factor, Array]] = [{} for _ in robot.learned]

    def drift() -> None:
        """Let the contacts of the next steps move by what was learned of the motion, as the wheels roll now."""
        wheels, inputs = state["wheels"][0, :n_wheels], np.zeros((1, len(INPUTS)))
        speed = wheels["rate_radps"] * robot.wheel_radius_m
        inputs[:, :3] = rolled_twist(robot, speed[None], wheels["steer_rad"][None])
        change = rolling_change(robot.learned, inputs, np.array([1.0 / scenario.rate_hz]), lags)[0]
        state["drift_x_mps"], state["drift_y_mps"], state["drift_radps"] = change

    if controller is None:
        wheels = wheel_motion(robot, scenario.twist, 1 / scenario.rate_hz)
        decided = np.hstack([wheels.twist, wheels.wheel_radps, wheels.steer_rad])
        held = np.repeat(decided, substeps, axis=0)
        every = substeps if robot.learned else n_steps
        for begin in range(0, n_steps, every):
            part = slice(begin, begin + every)
            if robot.learned:
                drift()
            given = held[part, of_wheels].copy(), held[part, of_steer].copy(), road_noise[part]
            advance(plant, profile, state, *given, rows[part])
    else:
        decided = np.empty((len(scenario.time_s), 3 + 2 * n_wheels))
        delay_steps = max(round(command_delay_s / STEP_S), 1)
        wheel_radps, steer_rad = np.zeros((2, n_steps, n_wheels))  # in force at each step
        done = 0
        for k, time_s in enumerate(scenario.time_s.tolist()):
            step = k * substeps
            part, done = slice(done, step + 1), step + 1
            if robot.learned:
                drift()
            advance(plant, profile, state, wheel_radps[part], steer_rad[part], road_noise[part], rows[part])
            if not is_finite(state):
                rows[done:] = filled(BODY_ROW, np.nan)
                break
            motion.grow(done)
            for sensor in sensors.values():
                sensor.update()
            arrived = ((name, sensor.arrived(time_s)) for name, sensor in sensors.items())
            readings = {name: reading for name, reading in arrived if reading is not None}
            first, *others = rows["wheels"]["patch_ratio"][step, :n_wheels].tolist()
            same = first >= 0 and all(other == first for other in others)
            terrain = scenario.patches[int(first)].terrain if same else ""
            command = controller(Sample(time_s, scenario.twist[k], readings, terrain))
            decided[k], row_status = _checked(command, n_wheels, status[0] if status else None, time_s)
            status.append(row_status)
            in_force = slice(step + delay_steps, step + delay_steps + substeps)
            wheel_radps[in_force], steer_rad[in_force] = decided[k, of_wheels], decided[k, of_steer]
        else:
            part = slice(done, n_steps)
            advance(plant, profile, state, wheel_radps[part], steer_rad[part], road_noise[part], rows[part])
    later = ("wheels", "encoder_rad", "roll_rad", "pitch_rad")
    finite = all(np.isfinite(rows[name]).all() for name in BODY_ROW.names or () if name not in later)
    limit_radps = MAX_WHEEL_SPEEDS * robot.motors.speed_max_radps
    if not finite or not np.abs(rows["wheels"]["wheel_radps"][:, :n_wheels]).max() <= limit_radps:
        raise ConfigError(
            f"robot {robot.name}: its motion cannot be integrated in steps of {STEP_S:g} s; a mass, an "
            "inertia, a stiffness, a gain or the load is out of scale with the rest"
        )

    motion.grow(n_steps)
    for sensor in sensors.values():
        sensor.update()
    streams = {name: sensor.stream() for name, sensor in sensors.items() if len(sensor.time_s) > 1}
    steers = len(robot.steer_rows)  # steered wheels are the first ones
    channels = (*TWIST, *sensing.wheel_channels("wheel_radps", robot.wheels), *robot.steer_rows)
    streams["commands"] = Stream(scenario.time_s, decided[:, : 3 + n_wheels + steers], channels)
    if status and status[0]:
        table = np.array([[row[name] for name in status[0]] for row in status])
        streams["control"] = Stream(scenario.time_s, table, tuple(status[0]))
    streams["truth"] = dynamic_truth(motion, robot, gyro_bias_radps, imu.time_s)
    # one label a stretch in which all wheels are on the same ground
    labels: list[Label] = []
    under = rows["wheels"]["patch_ratio"][:, :n_wheels]
    under = np.where((under == under[:, :1]).all(axis=1), under[:, 0], -1)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(under)) + 1, [n_steps]])
    for begin, end in pairwise(edges.tolist()):
        start_s, end_s = begin * STEP_S, end * STEP_S
        if under[begin] >= 0 and end_s - start_s >= MIN_LABEL_S:
            labels.append(
                Label(round(start_s, 3), round(end_s, 3), scenario.patches[int(under[begin])].terrain)
            )
    return streams, tuple(labels)


_WHEEL_TRUTH = (
    *("wheel_radps", "steer_rad", "slip_ratio", "slip_angle_rad", "normal_n", "traction_n", "torque_nm"),
    *("sinkage_m", "side_n"),
)


def dynamic_truth(motion: Motion, robot: Robot, gyro_bias_radps: Array, gyro_time_s: Array) -> Stream:
    """Return the truth of a robot's motion at 100 Hz, a compromise with the size of files.

    A slip that is never defined has no channel.
    """
    time_s, at = motion.at(sensing.TRUTH_HZ)
    rows = motion.record[at]
    of_wheels = {name: rows["wheels"][name][:, : len(robot.wheels)] for name in _WHEEL_TRUTH}
    if isinstance(robot, BicycleRobot):  # of its axles, slip is an angle first
        of_wheels["slip_rad"] = of_wheels.pop("slip_angle_rad")
    bias = {sensing.GYRO_BIAS: np.interp(time_s, gyro_time_s, gyro_bias_radps)}
    truth = sensing.truth_stream(time_s, rows, robot.wheels, of_wheels, bias)
    known = np.asarray(np.isfinite(truth.values).any(axis=0))
    channels = tuple(name for name, keep in zip(truth.channels, known, strict=True) if keep)
    return Stream(time_s, truth.values[:, known], channels)


def _checked(
    command: Command, wheels: int, first: Mapping[str, float] | None, time_s: float
) -> tuple[Array, dict[str, float]]:
    """Return twist, wheel rates and steering angles of a command in a row, and its status as the first one's."""
    row, where = np.empty(3 + 2 * wheels), f"of its command at {time_s:g} s"
    for name, begin, n in (("twist", 0, 3), ("wheel_radps", 3, wheels), ("steer_rad", 3 + wheels, wheels)):
        given = getattr(command, name)
        try:
            values = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (n,) or not np.isfinite(values).all():
            shown = " ".join(repr(given).split())
            raise DataError(f"controller: {name} {where} is {shown}, {n} finite numbers are required")
        row[begin : begin + n] = values
    try:
        status = {name: float(value) for name, value in command.status.items()}
        for name in status if first is None else ():
            unit_of(name)
    except (AttributeError, TypeError, ValueError, LogError) as error:
        raise DataError(f"controller: status {where}: {error}") from None
    if first is not None and status.keys() != first.keys():
        raise DataError(
            f"controller: status {where} has {', '.join(status) or 'nothing'}, "
            f"that of the first has {', '.join(first) or 'nothing'}: the same names are required"
        )
    return row, status
