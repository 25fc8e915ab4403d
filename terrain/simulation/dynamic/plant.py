"""All numbers of one simulated run that do not change during it.

Effects of the robot (:mod:`terrain.effects.catalogue`) act where a real robot would have them:

- **wheel_radius, one_sided_radius**: true radii of the wheels, of which the commands know nothing;
- **steering_delay, steering_backlash, steering_offset_i**: between the encoder, which the steering motor
  obeys, and the wheel: ``wheel(t) = play(encoder(t - T)) + d0``;
- **force_slip, shear_slip**: a creep of the contact on top of the ground's own slip.  Its deflection follows
  ``du/dt = (w r - v) - max(|w r|, |v|) (u / sigma + c f)`` with ``f = 3 F_i / W``, so that it settles
  where slip is that of the ground plus ``c f``, and no equation has to be solved for a force;
  of a shear curve ``c f`` is bent as in :func:`~terrain.simulation.contact.shear_slip`, up to the
  wheel's own limit.  A negative creep leaves a tenth of the ground's slip: no contact is stiffer than ten
  times it;
- **side_hill_slip**: the ground goes by sideways: wheels roll without side force where they drift downhill by
  ``c ph |v|``;
- **rolling_resistance, slip_resistance, viscous_drag**: more resistance at each axle, by its load, its slip
  and its share of the speed; what is less than none is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.effects import PlantPart, in_plant, parameters_of
from terrain.errors import ConfigError
from terrain.records import Array
from terrain.robots import Robot
from terrain.simulation.conditions import Conditions
from terrain.simulation.dynamic.profile import TerrainProfile
from terrain.simulation.sensors.motion import N_RECORD, STEP_S


class Plant(NamedTuple):
    """All numbers of one simulated run that do not change while it is driven."""

    wheels_m: Array
    com_m: Array
    com_height_m: float
    mass_kg: float
    yaw_inertia_kgm2: float
    radius_m: Array
    wheel_inertia_kgm2: float
    relaxation_m: float
    contact_length_m: float
    ride_stiffness_npm: float
    ride_damping_nspm: float
    load_fraction: Array
    load_per_force_ratio: Array
    reduction_ratio: float
    torque_max_nm: float
    speed_max_radps: float
    torque_time_constant_s: float
    friction_nm: float
    speed_gain: float
    speed_integral: float
    estimate_time_constant_s: float
    hall_steps: float
    report_time_constant_s: float
    steer_rate_max_radps: float
    steer_accel_max_radps2: float
    backlash_rad: float
    leg_backlash_rad: float
    grade_ratio: Array
    undulation_ratio: float
    undulation_length_m: float
    grounds: Array
    roughness_m3: Array
    patch_start_m: Array
    field: Array
    linked: bool
    steer_offset_rad: Array
    steer_backlash_rad: float
    steer_delay_steps: int
    hidden: bool
    weight_n: float
    force_slip_ratio: float
    shear_slip_ratio: float
    slip_resistance_ratio: float
    rolling_ratio: float
    drag_nspm: float
    side_hill_ratio: float


def make_plant(robot: Robot, conditions: Conditions, profile: TerrainProfile) -> Plant:
    """Return the plant of a robot with its load on its terrain.

    Parameters
    ----------
    robot : with sections body, motors, steering and sensors; of its effects those listed above act, and a
        payload
    conditions : load, slope, tyres and the backlash of the third leg
    profile : the terrain

    Raises
    ------
    ConfigError
        if the load takes the centre of mass out of the triangle of the wheels.
    """
    body, motors, steering, _, sensors = robot.equipment
    effects = dict.fromkeys(parameters_of(robot.drive), 0.0) | dict(robot.effects)
    mass_kg = robot.mass_kg * (1.0 + effects["payload_ratio"]) + conditions.payload_kg
    half = 0.5 * effects["one_sided_radius_ratio"]
    rolling = (1.0 + effects["wheel_radius_ratio"]) * np.array([1.0 - half, 1.0 - half, 1.0 + half])
    offset_m = conditions.payload_kg / mass_kg * np.asarray(conditions.payload_m)
    com_m = np.array([body.com_x_m, body.com_y_m]) + offset_m
    load_fraction, load_per_moment = _load_shares(robot, conditions, com_m)
    return Plant(
        wheels_m=np.array(robot.wheel_positions_m),
        com_m=com_m,
        com_height_m=body.com_height_m,
        mass_kg=mass_kg,
        yaw_inertia_kgm2=body.yaw_inertia_kgm2 * mass_kg / robot.mass_kg,
        radius_m=robot.wheel_radius_m * np.array(conditions.radius_factors) * rolling,
        wheel_inertia_kgm2=body.wheel_inertia_kgm2,
        relaxation_m=body.relaxation_length_m,
        contact_length_m=body.contact_length_m,
        ride_stiffness_npm=body.tyre_stiffness_npm,
        ride_damping_nspm=body.tyre_damping_nspm,
        load_fraction=load_fraction,
        load_per_force_ratio=np.ascontiguousarray(-body.com_height_m * load_per_moment),
        reduction_ratio=motors.reduction_ratio,
        torque_max_nm=motors.torque_max_nm,
        speed_max_radps=motors.speed_max_radps,
        torque_time_constant_s=motors.torque_time_constant_s,
        friction_nm=motors.friction_nm,
        speed_gain=motors.speed_gain_nmspr,
        speed_integral=motors.speed_integral_nmpr,
        estimate_time_constant_s=motors.speed_estimate_time_constant_s,
        hall_steps=sensors.hall_steps_ratio * motors.reduction_ratio / (2 * math.pi),
        report_time_constant_s=sensors.encoder_time_constant_s,
        steer_rate_max_radps=steering.rate_max_radps,
        steer_accel_max_radps2=steering.accel_max_radps2,
        backlash_rad=steering.dead_band_rad,
        leg_backlash_rad=float(conditions.leg_backlash_rad),
        grade_ratio=np.array(conditions.grade_ratio, dtype=float),
        undulation_ratio=float(conditions.undulation_ratio),
        undulation_length_m=float(conditions.undulation_length_m),
        grounds=np.ascontiguousarray(profile.grounds, dtype=float),
        roughness_m3=np.ascontiguousarray(profile.roughness_m3, dtype=float),
        patch_start_m=np.ascontiguousarray(profile.start_m, dtype=float),
        field=np.ascontiguousarray(profile.field, dtype=float),
        linked=any(effects[name] != 0.0 for name in in_plant(PlantPart.LINKAGE)),
        steer_offset_rad=np.array([effects[f"steering_offset_{i}_rad"] for i in (1, 2, 3)]),
        steer_backlash_rad=effects["steering_backlash_rad"],
        steer_delay_steps=round(effects["steering_delay_s"] / STEP_S),
        hidden=any(effects[name] != 0.0 for name in in_plant(PlantPart.CONTACT)),
        weight_n=robot.mass_kg * GRAVITY_MPS2,
        force_slip_ratio=effects["force_slip_ratio"],
        shear_slip_ratio=effects["shear_slip_ratio"],
        slip_resistance_ratio=effects["slip_resistance_ratio"],
        rolling_ratio=effects["rolling_resistance_ratio"],
        drag_nspm=effects["viscous_drag_nspm"],
        side_hill_ratio=effects["side_hill_slip_ratio"],
    )


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


def record_width(plant: Plant) -> int:
    """Return how many numbers are recorded a step: what the encoders see where a linkage hides the wheels."""
    return N_RECORD + 3 * plant.linked
