"""A swerve robot on its terrain: the records of the dynamic plant, and how stiff its contacts may be.

Effects of the robot (:mod:`terrain.effects`) act where a real robot would have them:

- **wheel_radius, one_sided_radius**: true radii of the wheels, of which the commands know nothing;
- **steering_delay, steering_backlash, steering_offset_i**: between the encoder, which the steering motor obeys, and the
  wheel: ``wheel(t) = play(encoder(t - T)) + d0``;
- **force_slip, shear_slip**: a creep of the contact on top of the ground's own slip.  Its deflection follows ``du/dt
  = (w r - v) - max(|w r|, |v|) (u / sigma + c f)`` with ``f = 3 F_i / W``, so that it settles where slip is that of
  the ground plus ``c f``, and no equation has to be solved for a force; of a shear curve ``c f`` is bent as in
  :func:`~terrain.simulation.contact.shear_slip`, up to the wheel's own limit.  A negative creep leaves a tenth of the
  ground's slip: no contact is stiffer than ten times it;
- **side_hill_slip**: the ground goes by sideways: wheels roll without side force where they drift downhill by
  ``c ph |v|``;
- **rolling_resistance, slip_resistance, viscous_drag**: more resistance at each axle, by its load, its slip and its
  share of the speed; what is less than none is none.

How stiff a contact may be for the steps of the integration: beyond that it pushes the robot by itself.  A wheel of
inertia I and radius r on a contact of stiffness ``K = (dF/ds) / sigma``, with the deflection u, the relaxation length
sigma and the damping T, :data:`terrain.simulation.contact.DEFLECTION_DAMPING_S`::

    F = K (u + T x)        x = w r - v        du/dt = x        dx/dt = -k u - k T x

with ``k = K (r^2 / I + 1 / m)`` and m the mass of the body.  ``step.step`` steps the rate first, and the deflection
with the new rate::

    x' = x - dt k (u + T x)        u' = u + dt x'

The characteristic polynomial is ``z^2 - (2 - dt k T - dt^2 k) z + 1 - dt k T``.  By Jury's criterion its roots are
inside the unit circle where ``4 - 2 dt k T - dt^2 k > 0``, that is ``k < 4 / (dt (dt + 2 T))``.  The decay of the
deflection with the distance rolled only widens this.  Beyond the limit a wheel's rate changes its sign from step to
step and grows until the contact slides.  Its force then jumps between the friction limits of the load, which for a
large mass exceed what the motors can give by orders of magnitude.

Three contacts share the body: the largest eigenvalue of all of them together is at most the largest of the wheels' own
plus the trace of the body's, ``sum K_i (2 / m + rho_i^2 / I_z)``, with rho_i the distance of a wheel from the centre of
mass.  A tyre as a spring k_t with a damper c under a corner of mass m_i is stepped alike, and is stable where
``dt^2 k_t + 2 dt c < 4 m_i``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.constants import GRAVITY_MPS2
from terrain.effects import EFFECTS, Stage, in_plant, parameters_of, vector_of
from terrain.errors import ConfigError
from terrain.kernels import filled, numbers, record
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.conditions import Conditions
from terrain.simulation.contact import DEFLECTION_DAMPING_S
from terrain.simulation.scenario import Scenario
from terrain.simulation.sensors import STEP_S
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import GROUND, ground_record, wheel_ground

FIELD_STEP_M = 0.1  # grid of the variation of the terrain along the path
# Cells of terrain up to the farthest point that the fastest wheel can reach; 24 h at 2 m/s take 3.5 million.
MAX_FIELD_CELLS = 5 * 10**6
MAX_DELAY_STEPS = 500  # steps of the longest delay of the steering, half a second
CONTACT_LIMIT_PS2 = 4.0 / (STEP_S * (STEP_S + 2.0 * DEFLECTION_DAMPING_S))  # largest stable ``k`` in 1/s^2
# Load transfer and rough ground load a wheel with up to so many times its share of the weight.
LOAD_MARGIN_RATIO = 2.0

_SMALL_SLIP = 1e-4

# A soil under the wheels, its ISO 8608 roughness, and the path length at which it begins, the first at 0.
PATCH = record({"ground": GROUND, "roughness_m3": float, "start_m": float})

PLANT = record(
    {
        "wheels_m": (float, (3, 2)),
        "com_m": (float, 2),
        "radius_m": (float, 3),
        "load_fraction": (float, 3),
        "load_per_force_ratio": (float, (3, 2)),
        "grade_ratio": (float, 2),
        "steer_offset_rad": (float, 3),
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
conditions; whether effects act in the linkages of the steering and where wheels touch the ground, and all effects."""

WHEEL_STATE = record(
    numbers(
        "rate_radps angle_rad steer_rad steer_motor_rad steer_motor_radps deflection_x_m "
        "deflection_y_m torque_nm integral_nm estimate_radps reported_radps hall_count ride_m "
        "ride_mps ride_mps2 road_m contact_m heading_rad creep_ratio"
    )
)
"""A wheel; its heading is that in the play of its linkage, and its creep is over the slip of the ground."""

STATE = record(
    numbers(
        "position_x_m position_y_m yaw_rad speed_x_mps speed_y_mps yaw_rate_radps path_m accel_x_mps2 "
        "accel_y_mps2 leg_rad"
    )
    | {"wheels": (WHEEL_STATE, 3), "n_steps": int, "late_rad": (float, (MAX_DELAY_STEPS, 3))}
)
"""Position is that of the body's origin; speeds and accelerations (dv/dt + w x v, of the step before) are
those of its centre of mass in body axes; the third leg is at 0 in the middle of its play; ``late_rad`` are
angles of the encoders that have not reached the wheels yet."""


class TerrainProfile(NamedTuple):
    """The terrain of one run along the path."""

    patches: Array  # (patches,) of :data:`PATCH`
    field: Array  # (2, 3, cells) factors along the path on thrust and on resistance, for each wheel


def uniform_profile(
    robot: Robot, *soils: Soil, roughness_m3: float = 0.0, start_m: tuple[float, ...] = (0.0,)
) -> TerrainProfile:
    """Return a terrain of one soil a patch without variation along the path, all patches equally rough."""
    return TerrainProfile(_patches(robot, soils, [roughness_m3] * len(soils), start_m), np.ones((2, 3, 1)))


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
    speed_max_radps = robot.equipment.motors.speed_max_radps
    farthest_m = 2.0 * robot.wheel_radius_m * speed_max_radps * scenario.time_s[-1]
    n_cells = math.ceil(farthest_m / FIELD_STEP_M) + 1
    if n_cells > MAX_FIELD_CELLS:
        raise ConfigError(
            f"robot {robot.name}: its wheels can come {farthest_m / 2e3:g} km far in this run, "
            f"{MAX_FIELD_CELLS * FIELD_STEP_M / 2e3:g} km of terrain are simulated at most"
        )
    keep = math.exp(-FIELD_STEP_M / conditions.field_length_m)
    white = rng.standard_normal((2, 3, n_cells))
    white[:, :, 1:] *= math.sqrt(1.0 - keep**2)
    unit = lfilter([1.0], [1.0, -keep], white, axis=2)
    patch_of_cell = np.searchsorted(start_m, np.arange(n_cells) * FIELD_STEP_M, side="right") - 1
    ratios = np.array([[soil.thrust_field_ratio, soil.resistance_field_ratio] for soil in used])
    spread = ratios[patch_of_cell].T
    field = np.exp(spread[:, None, :] * unit - 0.5 * spread[:, None, :] ** 2)
    roughness = [soil.roughness_m3 * conditions.roughness_factor for soil in used]
    return TerrainProfile(_patches(robot, used, roughness, start_m), field)


def _patches(
    robot: Robot, soils: Sequence[Soil], roughness_m3: Sequence[float], start_m: Sequence[float] | Array
) -> Array:
    body = robot.equipment.body
    patches = np.zeros(len(soils), PATCH)
    for patch, soil in zip(patches, soils, strict=True):
        (patch["ground"],) = ground_record(
            soil, robot.wheel_radius_m, body.tyre_width_m, body.contact_length_m
        )
    patches["roughness_m3"], patches["start_m"] = roughness_m3, start_m
    return patches


def make_plant(robot: Robot, conditions: Conditions) -> Array:
    """Return the plant of a robot with all sections and its load, (1,) of :data:`PLANT`.

    Raises
    ------
    ConfigError
        if the load takes the centre of mass out of the triangle of the wheels.
    """
    body, motors, steering, _, sensors = robot.equipment
    parts = (steering, body, motors, sensors, conditions)  # a torque is that of the motors
    described = {n: getattr(part, n) for part in parts for n in PLANT.names or () if hasattr(part, n)}
    effects = dict.fromkeys(parameters_of(robot.drive), 0.0) | dict(robot.effects)
    mass_kg = robot.mass_kg * (1.0 + effects["payload_ratio"]) + conditions.payload_kg
    half = 0.5 * effects["one_sided_radius_ratio"]
    rolling = (1.0 + effects["wheel_radius_ratio"]) * np.array([1.0 - half, 1.0 - half, 1.0 + half])
    offset_m = conditions.payload_kg / mass_kg * np.asarray(conditions.payload_m)
    com_m = np.array([body.com_x_m, body.com_y_m]) + offset_m
    load_fraction, load_per_moment = _load_shares(robot, conditions, com_m)
    of_robot = {
        "wheels_m": robot.wheel_positions_m,
        "com_m": com_m,
        "mass_kg": mass_kg,
        "weight_n": robot.mass_kg * GRAVITY_MPS2,
        "yaw_inertia_kgm2": body.yaw_inertia_kgm2 * mass_kg / robot.mass_kg,
        "radius_m": robot.wheel_radius_m * np.array(conditions.radius_factors) * rolling,
        "load_fraction": load_fraction,
        "load_per_force_ratio": -body.com_height_m * load_per_moment,
        "hall_steps": sensors.hall_steps_ratio * motors.reduction_ratio / (2 * math.pi),
        "linked": any(effects[name] != 0.0 for name in in_plant(Stage.LINKAGE)),
        "steer_offset_rad": [effects[f"steering_offset_{i}_rad"] for i in (1, 2, 3)],
        "yields": any(effects[name] != 0.0 for name in in_plant(Stage.CONTACT)),
        "effects": vector_of(effects).view(EFFECTS),
    }
    return filled(PLANT, **(described | of_robot))


def _load_shares(robot: Robot, conditions: Conditions, com_m: Array) -> tuple[Array, Array]:
    """Return the load (3,) of each wheel over the weight, and per moment about the two body axes (3, 2)."""
    # Rows: vertical force, moment about y (x arm), moment about x (y arm); columns: the three wheels.
    inverse = np.linalg.inv(np.vstack([np.ones(3), robot.wheel_positions_m.T]))
    load_fraction = inverse @ np.array([1.0, com_m[0], com_m[1]])
    if load_fraction.min() <= 0.0:
        x_m, y_m = conditions.payload_m
        raise ConfigError(
            f"robot {robot.name}: a payload of {conditions.payload_kg:g} kg at ({x_m:g}, {y_m:g}) m "
            f"from the centre of mass tips it over: wheel {int(load_fraction.argmin()) + 1} would carry "
            "nothing"
        )
    return load_fraction, inverse[:, 1:]


def start_state(steer_rad: Array) -> Array:
    """Return the state, (1,) of :data:`STATE`, of a robot at rest at the origin, its steering motors at 0.

    Its wheels hang in their play at ``steer_rad`` (3,).
    """
    wheels = np.zeros(3, WHEEL_STATE)
    wheels["steer_rad"] = wheels["heading_rad"] = steer_rad
    return filled(STATE, wheels=wheels, late_rad=steer_rad)


def contact_ratio(plant: Array, profile: TerrainProfile) -> float:
    """Return ``k`` of a plant under its weight, on its stiffest ground, over its limit: unstable from 1 on."""
    robot = plant[0]
    load_n = robot["mass_kg"] * GRAVITY_MPS2 * robot["load_fraction"]
    spin = robot["radius_m"] ** 2 / robot["wheel_inertia_kgm2"]
    arm_m2 = ((robot["wheels_m"] - robot["com_m"]) ** 2).sum(axis=1)
    body = 2.0 / robot["mass_kg"] + arm_m2 / robot["yaw_inertia_kgm2"]
    rates_ps2 = []
    for ground in profile.patches["ground"]:  # the thrust over its slip is steepest at the start of the curve
        slope_n = np.array([wheel_ground(ground, load, _SMALL_SLIP, 0.0)[0] for load in load_n]) / _SMALL_SLIP
        stiffness_npm = slope_n / robot["relaxation_length_m"]
        rates_ps2.append((stiffness_npm * spin).max() + (stiffness_npm * body).sum())
    return float(max(rates_ps2)) / CONTACT_LIMIT_PS2


def tyre_ratio(plant: Array) -> float:
    """Return how stiff and damped the tyres are over their limit: unstable from 1 on."""
    robot = plant[0]
    corner_kg = robot["mass_kg"] * float(robot["load_fraction"].min())
    damped = STEP_S * robot["tyre_stiffness_npm"] + 2.0 * robot["tyre_damping_nspm"]
    return float(STEP_S * damped / 4.0 / corner_kg)


def check_step(plant: Array, profile: TerrainProfile, name: str) -> None:
    """Refuse a robot on its terrain whose contacts or tyres are too stiff for the steps of the integration.

    Raises
    ------
    ConfigError
        if the contacts, with :data:`LOAD_MARGIN_RATIO`, or the tyres are beyond their limit, or not finite.
    """
    steps = f"robot {name}: its motion cannot be integrated in steps of {STEP_S:g} s: "
    mass_kg = plant["mass_kg"][0]
    contact, tyre = LOAD_MARGIN_RATIO * contact_ratio(plant, profile), tyre_ratio(plant)
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
