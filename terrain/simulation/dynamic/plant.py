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
from terrain.simulation.sensors.motion import N_RECORD, STEP_S

FIELD_STEP_M = 0.1
"""Grid on which the ground varies along the way."""


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


def make_plant(
    robot: Robot,
    *,
    payload_kg: float,
    payload_m: tuple[float, float],
    radius_factors: Array,
    grade_ratio: tuple[float, float],
    undulation_ratio: float,
    undulation_length_m: float,
    leg_backlash_rad: float,
    grounds: Array,
    roughness_m3: Array,
    patch_start_m: Array,
    field: Array,
) -> Plant:
    """Return the plant of a robot with its load on its ground.

    Parameters
    ----------
    robot : with sections body, motors, steering and sensors; of its effects those act that are listed above,
        and a payload
    payload_kg, payload_m : load on top and where it lies from the empty robot's centre of mass, body axes
    radius_factors : (3,) true rolling radius of each wheel over the nominal one
    grade_ratio : (2,) mean gradient of the ground along world x and y, uphill positive
    undulation_ratio, undulation_length_m : amplitude of a gradient that changes along the way, and its wave
    length
    leg_backlash_rad : half the play of the third leg's hinge
    grounds : (patches, GROUND_SIZE) of ``terrain.terramechanics``
    roughness_m3 : (patches,) ISO 8608 roughness
    patch_start_m : (patches,) path length at which each begins, the first at 0
    field : (2, 3, cells) factors along the way on thrust and on resistance, for each wheel

    Raises
    ------
    ConfigError
        if the load takes the centre of mass out of the triangle of the wheels.
    """
    body, motors, steering, _, sensors = robot.equipment
    effects = dict.fromkeys(parameters_of(robot.drive), 0.0) | dict(robot.effects)
    mass_kg = robot.mass_kg * (1.0 + effects["payload_ratio"]) + payload_kg
    half = 0.5 * effects["one_sided_radius_ratio"]
    rolling = (1.0 + effects["wheel_radius_ratio"]) * np.array([1.0 - half, 1.0 - half, 1.0 + half])
    com_m = np.array([body.com_x_m, body.com_y_m]) + payload_kg / mass_kg * np.asarray(payload_m)
    # Rows: vertical force, moment about y (x arm), moment about x (y arm); columns: the three wheels.
    balance = np.vstack([np.ones(3), robot.wheel_positions_m.T])
    inverse = np.linalg.inv(balance)
    load_fraction = inverse @ np.array([1.0, com_m[0], com_m[1]])
    if load_fraction.min() <= 0.0:
        raise ConfigError(
            f"robot {robot.name}: a payload of {payload_kg:g} kg at ({payload_m[0]:g}, {payload_m[1]:g}) m "
            f"from the centre of mass tips it over: wheel {int(load_fraction.argmin()) + 1} would carry "
            "nothing"
        )
    return Plant(
        wheels_m=np.array(robot.wheel_positions_m),
        com_m=com_m,
        com_height_m=body.com_height_m,
        mass_kg=mass_kg,
        yaw_inertia_kgm2=body.yaw_inertia_kgm2 * mass_kg / robot.mass_kg,
        radius_m=robot.wheel_radius_m * np.asarray(radius_factors, dtype=float) * rolling,
        wheel_inertia_kgm2=body.wheel_inertia_kgm2,
        relaxation_m=body.relaxation_length_m,
        contact_length_m=body.contact_length_m,
        ride_stiffness_npm=body.tyre_stiffness_npm,
        ride_damping_nspm=body.tyre_damping_nspm,
        load_fraction=load_fraction,
        load_per_force_ratio=np.ascontiguousarray(-body.com_height_m * inverse[:, 1:]),
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
        leg_backlash_rad=float(leg_backlash_rad),
        grade_ratio=np.array(grade_ratio, dtype=float),
        undulation_ratio=float(undulation_ratio),
        undulation_length_m=float(undulation_length_m),
        grounds=np.ascontiguousarray(grounds, dtype=float),
        roughness_m3=np.ascontiguousarray(roughness_m3, dtype=float),
        patch_start_m=np.ascontiguousarray(patch_start_m, dtype=float),
        field=np.ascontiguousarray(field, dtype=float),
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


def record_width(plant: Plant) -> int:
    """Return how many numbers are recorded a step: what the encoders see where a linkage hides the wheels."""
    return N_RECORD + 3 * plant.linked
