"""Whether the numbers of a robot's description belong together: lengths, masses, torques, speeds, angles.

A length in millimetres or an angle in degrees is a number like any other, and what is simulated or estimated with it
is wrong throughout.  Each number has a range that follows from the others by geometry or mechanics, wide enough for
vehicles from a model car of 0.2 m to a dump truck of 300 t; beyond it the description is refused in one sentence.

Of the three lengths (track, wheelbase, twice the wheel's diameter) the one that is far from the median is the odd one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.logs.schema import UNIT_SCALES

Robot = Any  #: A :class:`terrain.robots.Robot`, which imports this module.


class Size(NamedTuple):
    """A number of a description and the range that it is expected in; ``why`` is what the range follows from."""

    name: str
    value: float
    low: float
    high: float
    why: str = ""


LENGTH_M = (0.02, 25.0)  #: Of track and wheelbase: from a robot that fits a palm to the longest trucks
RADIUS_M = (0.004, 2.5)
#: Lengths over their median; the largest of built robots are 4 (a truck's wheelbase) and 1/6 (a pallet jack's wheels).
PROPORTION = (1 / 6, 6.0)
RADIUS_PROPORTION = (1 / 12, 6.0)
TRACK_OVER_WHEELBASE = (0.2, 5.0)
#: Mass over a box with the area of the wheels and a height of its root, kg/m^3: gantries have 4, tanks 900.
DENSITY_KGPM3 = (1.0, 5000.0)
#: Radius of gyration over half the diagonal of the wheels: built robots have 0.66 to 0.92.
GYRATION = (0.2, 2.5)
MAX_LEVER = 5.0  #: Lengths of the robot that a sensor stands out from it.
#: Back-EMF at top speed over the supply's voltage: up to 1, and more with field weakening.
EMF_OVER_SUPPLY = (0.02, 3.0)
#: Torques of all wheels over what lifts the robot by their circumference: 1 to 3 of built robots.
TORQUE_OVER_WEIGHT = (0.02, 50.0)
SPEED_MPS = (0.01, 120.0)

#: Ranges of numbers of sections that no other number bounds, by the end of their name.
ALONE: dict[str, tuple[float, float]] = {
    "efficiency_ratio": (0.01, 1.0),
    "_scale_x_ratio": (0.5, 1.5),
    "_scale_y_ratio": (0.5, 1.5),
    "_scale_z_ratio": (0.5, 1.5),
    "_time_constant_s": (0.0, 3.0),
    "latency_s": (0.0, 3.0),
    "_delay_s": (-5.0, 5.0),
    "rate_max_radps": (0.005, 20.0),
    "accel_max_radps2": (0.02, 1000.0),
    "dead_band_rad": (0.0, 0.5),
    "zero_1_rad": (-2 * np.pi, 2 * np.pi),
    "zero_2_rad": (-2 * np.pi, 2 * np.pi),
    "zero_3_rad": (-2 * np.pi, 2 * np.pi),
    "pose_yaw_rad": (-2 * np.pi, 2 * np.pi),
    "steering_offset_rad": (-1.0, 1.0),
    "steering_gain_ratio": (0.2, 5.0),
    "understeer_s2pm": (-1.0, 1.0),
    "gyro_std_radps": (0.0, 0.5),
    "bias_std_radps": (0.0, 0.5),
    "bias_x_radps": (-0.5, 0.5),
    "bias_y_radps": (-0.5, 0.5),
    "bias_z_radps": (-0.5, 0.5),
    "bias_x_mps2": (-5.0, 5.0),
    "bias_y_mps2": (-5.0, 5.0),
    "bias_z_mps2": (-5.0, 5.0),
    "bias_std_mps2": (0.0, 5.0),
    "accel_std_mps2": (0.0, 20.0),
    "yaw_rate_std_radps": (0.0, 1.0),
    "tilt_std_rad": (0.0, 0.5),
    "yaw_std_rad": (0.0, 1.6),
    "speed_std_mps": (0.0, 3.0),
    "position_std_m": (0.0, 20.0),
    "rate_hz": (0.0, 1e5),
}
#: Identified values over the nominal ones: tyres deform by a tenth; skidding makes the effective track 1 to 4 times
#: the distance of the sides, and what identifies it has an interval.
IDENTIFIED_OVER_NOMINAL = {
    "rolling_radius_m": ("wheel_radius_m", 0.5, 1.5),
    "effective_track_m": ("track_m", 0.7, 5.0),
    "wheel_distance_m": ("wheel_distance_m", 0.6, 1.6),
    "wheelbase_m": ("wheelbase_m", 0.6, 1.6),
    "effective_wheelbase_m": ("wheelbase_m", 0.4, 5.0),
}


def refuse_odd_sizes(place: str, robot: Robot) -> None:
    """Raise ``ConfigError`` with the first number of a robot that cannot belong to the others.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from terrain.robots import load_robot
    >>> refuse_odd_sizes("mine.yaml", replace(load_robot("husky"), wheel_radius_m=1.65))
    Traceback (most recent call last):
    terrain.errors.ConfigError: mine.yaml: wheel_radius_m is 1.65, 0.0119 to 0.856 m is expected (beside ...
    """
    for size in _sizes(robot):
        if not size.low <= size.value <= size.high:
            key, factor = robot.spelled.get(size.name, (size.name, 1.0))
            value, low, high = (each / factor for each in size[1:4])
            range_text = " to ".join(f"{float(f'{each:.3g}'):g}" for each in (low, high))
            unit = key.rpartition("_")[2]
            shown = UNIT_NAMES.get(unit, unit)
            why = f" ({size.why})" if size.why else ""
            raise ConfigError(
                f"{place}: {key} is {value:.6g}, {range_text} {shown} is expected{why}: "
                + unit_mistake(unit, value, low, high)
            )


UNIT_NAMES = {
    "mps": "m/s",
    "radps": "rad/s",
    "radps2": "rad/s^2",
    "mps2": "m/s^2",
    "ratio": "",
    "kgm2": "kg m^2",
}
UNIT_NAMES |= {
    "nm": "Nm",
    "v": "V",
    "npm": "N/m",
    "npr": "N/rad",
    "nmpa": "Nm/A",
    "s2pm": "s^2/m",
    "hz": "Hz",
}
#: Other units of what logs do not have, and their factor to SI.
_OTHER_UNITS = {
    "kg": {"g": 1e-3},
    "kgm2": {"kg cm^2": 1e-4, "kg mm^2": 1e-6},
    "npm": {"N/mm": 1e3, "kN/m": 1e3},
    "npr": {"N/deg": 180.0 / np.pi, "kN/rad": 1e3},
    "nmpa": {"mNm/A": 1e-3},
    "radps2": {"deg/s^2": np.pi / 180.0},
    "hz": {"kHz": 1e3},
}


def unit_mistake(unit: str, value: float, low: float, high: float) -> str:
    """Return what a number out of its range may be in, as a question.

    Examples
    --------
    >>> unit_mistake("m", 165.0, 0.01, 1.0), unit_mistake("rad", 4000.0, 0.0, 1.6)
    ('in mm?', 'another unit, or a misplaced decimal point?')
    """
    known = {name: factor for name, (word, factor) in UNIT_SCALES.items() if word == unit and factor != 1.0}
    known |= _OTHER_UNITS.get(unit, {})
    fitting = {name: factor for name, factor in known.items() if low <= value * factor <= high}
    if not fitting:
        return "another unit, or a misplaced decimal point?"
    middle = math.sqrt(low * high) if low > 0.0 else high / 10.0
    nearest = min(fitting, key=lambda name: abs(math.log(abs(value) * fitting[name] / middle)))
    return f"in {nearest}?"


def _sizes(robot: Robot) -> Iterator[Size]:
    """Yield the numbers of a robot that have a range."""
    radius_m, track_m, wheelbase_m, mass_kg = (
        *(robot.wheel_radius_m, robot.track_m, robot.wheelbase_m, robot.mass_kg),
    )
    yield Size("track_m", track_m, *LENGTH_M)
    yield Size("wheelbase_m", wheelbase_m, *LENGTH_M)
    yield Size("wheel_radius_m", radius_m, *RADIUS_M)
    length_m = float(np.median([track_m, wheelbase_m, 4.0 * radius_m]))
    lengths = f"track_m {track_m:.3g}, wheelbase_m {wheelbase_m:.3g}, wheel_radius_m {radius_m:.3g}"
    for key, (name, _) in robot.spelled.items():
        lengths = lengths.replace(key, name) if name != "wheel_distance_m" else lengths
    beside = f"beside {lengths}"
    low, high = PROPORTION
    yield Size("track_m", track_m, low * length_m, high * length_m, beside)
    yield Size("wheelbase_m", wheelbase_m, low * length_m, high * length_m, beside)
    low, high = RADIUS_PROPORTION
    yield Size("wheel_radius_m", radius_m, low * length_m / 4, high * length_m / 4, beside)
    low, high = TRACK_OVER_WHEELBASE
    yield Size("track_m", track_m, low * wheelbase_m, high * wheelbase_m, beside)
    size_m, half_m = max(track_m, wheelbase_m), math.hypot(track_m, wheelbase_m) / 2.0
    volume_m3 = ((wheelbase_m + 2 * radius_m) * (track_m + radius_m)) ** 1.5
    low, high = (each * volume_m3 for each in DENSITY_KGPM3)
    yield Size("mass_kg", mass_kg, low, high, beside)
    of_mass = f"of {mass_kg:.3g} kg and {lengths}"
    low, high = (mass_kg * (each * half_m) ** 2 for each in GYRATION)
    if hasattr(type(robot), "yaw_inertia_kgm2"):
        yield Size("yaw_inertia_kgm2", robot.yaw_inertia_kgm2, low, high, of_mass)
    elif robot.describes("body"):
        yield Size("body.yaw_inertia_kgm2", robot.body.yaw_inertia_kgm2, low, high, of_mass)
    yield from _own_sizes(robot, size_m)
    for name, part in robot.parts.items():
        yield from _alone(f"{name}.", {key: getattr(part, key) for key in part.__dataclass_fields__}, size_m)
    if robot.describes("body"):
        yield from _body_sizes(robot, size_m)
    if robot.describes("motors"):
        yield from _motor_sizes(robot)
    for key, value in robot.identified.items():
        of_all = "effective_track_m" if key.startswith("effective_track_") else key  # or of one ground
        if of_all in IDENTIFIED_OVER_NOMINAL:
            of, low, high = IDENTIFIED_OVER_NOMINAL[of_all]
            nominal = getattr(robot, of)
            yield Size(f"identified.{key}", value, low * nominal, high * nominal, f"{of} is {nominal:.3g} m")
    yield from _alone("identified.", robot.identified, size_m)


def _alone(place: str, values: Mapping[str, float], size_m: float) -> Iterator[Size]:
    """Yield the numbers of a section that have a range of their own, and its lever arms."""
    reach_m = MAX_LEVER * size_m
    for key, value in values.items():
        if key.startswith("lever_") or key in ("pose_x_m", "pose_y_m"):
            yield Size(f"{place}{key}", value, -reach_m, reach_m, f"a robot of {size_m:.3g} m")
        for end, (low, high) in ALONE.items():
            if key.endswith(end):
                yield Size(f"{place}{key}", value, low, high)


def _own_sizes(robot: Robot, size_m: float) -> Iterator[Size]:
    """Yield the numbers that only some drives have."""
    own = {name: getattr(robot, name) for name in robot.numbers if hasattr(robot, name)}
    weight_n = GRAVITY_MPS2 * robot.mass_kg
    ranges = {
        "com_height_m": (0.0, 2.0 * size_m),
        "first_wheel_rad": (-2 * np.pi, 2 * np.pi),
        "steering_time_constant_s": (0.0, 3.0),
        "steering_rate_radps": (0.005, 20.0),
        "speed_max_mps": SPEED_MPS,
        "front_cornering_npr": (0.5 * weight_n / 2, 500.0 * weight_n / 2),
        "rear_cornering_npr": (0.5 * weight_n / 2, 500.0 * weight_n / 2),
    }
    for name, (low, high) in ranges.items():
        if name in own:
            yield Size(name, own[name], low, high)


def _body_sizes(robot: Robot, size_m: float) -> Iterator[Size]:
    body, radius_m, mass_kg = robot.body, robot.wheel_radius_m, robot.mass_kg
    of_wheel = f"a wheel of radius {radius_m:.3g} m"
    low_m, high_m, half_m, where = -size_m, size_m, size_m, f"a robot of {size_m:.3g} m"
    if (
        robot.n_tyres == 4 or robot.skids
    ):  # beyond the wheels it would tip over; of three see Robot.check_load
        x_m, where = robot.wheel_positions_m[:, 0], "between the wheels, beyond which it tips over"
        low_m, high_m, half_m = float(x_m.min()), float(x_m.max()), robot.track_m / 2
        if robot.skids:
            low_m, high_m = -robot.wheelbase_m / 2, robot.wheelbase_m / 2
    yield Size("body.com_x_m", body.com_x_m, low_m, high_m, where)
    yield Size("body.com_y_m", body.com_y_m, -half_m, half_m, where)
    yield Size("body.com_height_m", body.com_height_m, 0.0, 2.0 * size_m, f"a robot of {size_m:.3g} m")
    yield Size("body.tyre_width_m", body.tyre_width_m, 0.02 * radius_m, 5.0 * radius_m, of_wheel)
    # of a tyre a chord, of a track a part of its length
    longest_m = max(2.0 * radius_m, robot.wheelbase_m if robot.drive == "tracked" else 0.0)
    yield Size("body.contact_length_m", body.contact_length_m, 0.01 * radius_m, longest_m, of_wheel)
    yield Size(
        "body.relaxation_length_m", body.relaxation_length_m, 0.005 * radius_m, 20 * radius_m, of_wheel
    )
    inertia_kgm2 = mass_kg * radius_m**2
    of_mass = f"{of_wheel} of a robot of {mass_kg:.3g} kg"
    yield Size(
        "body.wheel_inertia_kgm2", body.wheel_inertia_kgm2, 1e-5 * inertia_kgm2, 10 * inertia_kgm2, of_mass
    )
    load_n = mass_kg * GRAVITY_MPS2 / robot.n_tyres  # which presses a tyre in by a part of its radius
    low, high = load_n / (0.7 * radius_m), load_n / (1e-6 * radius_m)
    yield Size("body.tyre_stiffness_npm", body.tyre_stiffness_npm, low, high, of_mass)


def _motor_sizes(robot: Robot) -> Iterator[Size]:
    motors, radius_m = robot.motors, robot.wheel_radius_m
    low, high = (
        each * robot.mass_kg * GRAVITY_MPS2 * radius_m / len(robot.wheels) for each in TORQUE_OVER_WEIGHT
    )
    of_robot = f"a robot of {robot.mass_kg:.3g} kg on wheels of radius {radius_m:.3g} m"
    yield Size("motors.torque_max_nm", motors.torque_max_nm, low, high, of_robot)
    yield Size("motors.friction_nm", motors.friction_nm, 0.0, motors.torque_max_nm, "torque_max_nm")
    low, high = (each / radius_m for each in SPEED_MPS)
    yield Size(
        "motors.speed_max_radps", motors.speed_max_radps, low, high, f"wheels of radius {radius_m:.3g} m"
    )
    emf_v = motors.speed_max_radps * motors.reduction_ratio * motors.torque_constant_nmpa
    low, high = emf_v / EMF_OVER_SUPPLY[1], emf_v / EMF_OVER_SUPPLY[0]
    why = (
        f"its motors induce {emf_v:.3g} V at speed_max_radps {motors.speed_max_radps:.3g}, reduction_ratio "
        f"{motors.reduction_ratio:.3g} and torque_constant_nmpa {motors.torque_constant_nmpa:.3g}"
    )
    yield Size("motors.supply_v", motors.supply_v, low, high, why)
