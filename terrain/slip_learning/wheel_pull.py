"""What each wheel of a run pulled, and at which slip: motor current, load and slip on one clock.

Of wheel i, with its rate w, radius r, inertia J, the current I of its motor, the robot's mass m and its
specific force f = a + g up (what an accelerometer reads)::

    T = I kt n eta                                       torque at the wheel
    F = (T - T_friction tanh(w / w_0) - J dw/dt) / r     thrust of the ground
    N = m (share_i f_z - h (G_i . (f_x, f_y)))           load: three contacts under a rigid body
    sum F u = m f u + rho sum N                          balance along the way u: mass m, resistance ratio rho

The torque constant kt, the reduction n and the efficiency eta are those of the robot's description.  The
efficiency is taken as one factor between current and torque, driving and driven alike, as in
:mod:`terrain.simulation.sensors`; a reduction that is driven by its wheel has it the other way round, so that
braking forces of a real robot come out too small by about its square.

Slips come behind the encoders' low-pass, the current does not: everything goes through the same low-pass.
Thrust follows the slip only over the relaxation length sigma of the contact (Pacejka, Tyre and Vehicle
Dynamics, 7.2.1), so that in a start it belongs to a slip of a moment ago.  The slip given here is that of the
contact, u / sigma with ``du/dt = (w r - v) - max(|w r|, |v|) u / sigma``; in steady motion it is the slip
ratio.

Ground is taken for isotropic (:mod:`terrain.terramechanics.traction`): a wheel that slips sideways as well,
as on a cross slope, gives its force along the slip vector.  Its sample is the length of that vector and the
whole force.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numba import njit

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.measurements.resampling import on_clock
from terrain.estimation.measurements.table import MeasurementTable
from terrain.kinematics.wheel_velocity import TWIST, wheel_frame_velocities
from terrain.records import Array, Label, RunLog, SlipTrack, StateTrack, read_only
from terrain.robots import Robot

MIN_SPEED_MPS = 0.2
"""Slower, 1 cm/s of error in the speed is over 5 % of slip."""

MAX_SLIP_STD = 0.05
"""A slip known no better tells nothing about a curve that rises within 0.1 to 0.3."""

MAX_SIDE_RATIO = 0.5
"""Sideways slip over that ahead beyond which a wheel is no longer judged by what it pulls ahead."""

SMALL_SLIP = 0.02
"""Sideways slip this small takes nothing worth the name from the thrust."""

MAX_SLIP_ANGLE_RAD = 0.15
"""Of the balance: the side forces' parts along the way are then within a ninth of them."""

MAX_YAW_RATE_RADPS = 0.1
"""Of the balance, which leaves side forces out."""

MIN_LOAD_SHARE = 0.35
"""Share of its standing load under which a wheel is about to lift and its F / N is noise over noise."""

MAX_TORQUE_SHARE = 0.985
"""A motor at its limit gives the same thrust on good and on bad spots, and slips more on the bad: such
samples would bend the curve down."""

MAX_SLIP_RATE_PS = 3.0
"""Slip that changes faster is smeared by the 50 ms of the low-pass over more than 0.15."""

MAX_THRUST_RATE_PS = 1.0
"""Thrust over load that changes faster is on its way to another slip: the slip it belongs to is not known to
50 ms."""

LABEL_EDGE_S = 0.3
"""What is left in the low-pass from the ground before, e^-6 of it, is nothing."""

FRICTION_RATE_RADPS = 0.1
"""Rate over which bearing friction takes its full size, as in the simulation."""

SAMPLE_S = 0.2
"""Length of a sample: ten of the wheels' own, which takes the ripple of Hall steps to a third."""

LAG_S = 0.02
"""To one sample of the wheels it is known which slip a thrust belongs to."""

BALANCE_S = 0.5
"""Length of a sample of the body's balance; the ride at 7 Hz averages out."""

BALANCE_MEMORY = 4.0
"""Neighbouring samples of the balance err alike, over 2 s of ground."""

MIN_BLOCKS = 4
"""Fewer samples of the balance make no median."""

THRUST_STD_RATIO = 0.03
"""Error of all thrusts of a run alike: of the torque constant with the motor's warmth, and of currents that
are sampled in step with the commands."""

MASS_STD_RATIO = 0.15
"""What is believed of the mass before a run: loads to a third of the robot (data/spread), of which nobody
told."""

MAX_MASS_STDS = 4.0
"""No mass further than this from what was believed is taken: 36 to 144 kg for 90."""

TILT_STD_RAD = 0.01
"""Error of a grade by the attitude: mounting, and the body's tilt on its springs and on rough ground."""

RATE_SMOOTHING_S = 0.06
"""Centred mean under the wheel's acceleration: Hall steps and noise of three samples."""


@dataclass(frozen=True, slots=True, eq=False)
class WheelPull:
    """Thrust, load and slip of each wheel over a run; positive in traction whichever way a wheel rolls.

    Parameters
    ----------
    time_s : (n,) clock of the wheels
    slip_ratio, slip_std : (n, wheels) of the contact, its sideways part included; NaN where unknown
    thrust_n : (n, wheels) what the ground gives along that slip, before any resistance
    load_npkg : (n, wheels) load over the robot's mass
    speed_mps : (n, wheels) the larger of wheel speed and speed over ground
    pull_n : (n,) sum of the thrusts along the way
    way_mps : (n,) speed
    grade_mps2 : (n,) part of gravity against the way: uphill positive
    normal_mps2 : (n,) specific force across the ground
    thrust_std_n : of one thrust, by the noise of current and rate
    sound : by name, whether (n, wheels) a sample may be believed
    balanced : (n,) whether an instant may go into the balance of the body
    """

    time_s: Array
    slip_ratio: Array
    slip_std: Array
    thrust_n: Array
    load_npkg: Array
    speed_mps: Array
    pull_n: Array
    way_mps: Array
    grade_mps2: Array
    normal_mps2: Array
    thrust_std_n: float
    sound: Mapping[str, Array]
    balanced: Array

    def __post_init__(self) -> None:
        for name in ("time_s", "slip_ratio", "slip_std", "thrust_n", "load_npkg", "speed_mps"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("pull_n", "way_mps", "grade_mps2", "normal_mps2"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        object.__setattr__(self, "balanced", read_only(self.balanced, np.bool_))
        object.__setattr__(self, "sound", MappingProxyType(dict(self.sound)))

    @property
    def believed(self) -> Array:
        """Whether (n, wheels) every condition of :attr:`sound` holds."""
        return np.asarray(np.logical_and.reduce(list(self.sound.values())))

    def on(self, labels: tuple[Label, ...], terrain: str) -> Array:
        """Return where (n,) a label says this terrain, its edges left out but at the ends of the run."""
        inside = np.zeros(self.time_s.size, dtype=bool)
        for start_s, end_s, name in labels:
            if name == terrain:
                begin = start_s + (LABEL_EDGE_S if start_s > self.time_s[0] else 0.0)
                inside |= (self.time_s >= begin) & (self.time_s < end_s)
        return inside


def wheel_torque(
    current_a: Array, torque_constant_nmpa: float, reduction_ratio: float, efficiency_ratio: float
) -> Array:
    """Return the torque at the wheel in Nm by the current of its motor; any shape.

    Examples
    --------
    >>> wheel_torque(np.array([10.0, -10.0]), 0.25, 10.0, 0.85)
    array([ 21.25, -21.25])
    """
    return np.asarray(current_a) * (torque_constant_nmpa * reduction_ratio * efficiency_ratio)


def ground_thrust(
    torque_nm: Array,
    wheel_radps: Array,
    accel_radps2: Array,
    friction_nm: float,
    inertia_kgm2: float,
    wheel_radius_m: float,
) -> Array:
    """Return the force in N that the ground gives a wheel, along the wheel's own x axis; any shape.

    Examples
    --------
    >>> ground_thrust(np.array([20.0]), np.array([5.0]), np.array([10.0]), 0.5, 0.15, 0.2).round(1)
    array([90.])
    """
    friction = friction_nm * np.tanh(wheel_radps / FRICTION_RATE_RADPS)
    return np.asarray((torque_nm - friction - inertia_kgm2 * accel_radps2) / wheel_radius_m)


def wheel_loads(robot: Robot, force_mps2: Array) -> Array:
    """Return the load of each wheel over the robot's mass, (n, 3) N/kg, by the body's specific force (n, 3).

    Three contacts carry a rigid body: the loads follow from the balance of forces and of the two moments.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> standing = np.array([[0.0, 0.0, 9.0], [1.0, 0.0, 9.0]])  # the second speeds up or climbs
    >>> wheel_loads(load_robot("agrimaro"), standing).round(2)
    array([[3.  , 3.  , 3.  ],
           [3.49, 2.51, 3.  ]])
    """
    body = robot.equipment.body
    inverse = np.linalg.inv(np.vstack([np.ones(3), robot.wheel_positions_m.T]))
    share = inverse @ np.array([1.0, body.com_x_m, body.com_y_m])
    return np.asarray(force_mps2[:, 2:] * share - body.com_height_m * force_mps2[:, :2] @ inverse[:, 1:].T)


@njit(cache=True)
def contact_slip(time_s: Array, slip_speed_mps: Array, fastest_mps: Array, relaxation_m: float) -> Array:
    """Return the slip (n,) of a contact that follows its slip speed over its relaxation length.

    Parameters
    ----------
    time_s : (n,) strictly increasing
    slip_speed_mps : (n,) w r - v
    fastest_mps : (n,) the larger of the speeds of rim and ground, without sign
    relaxation_m : above 0

    Examples
    --------
    >>> time_s = np.arange(0.0, 1.0, 0.02)
    >>> slip = contact_slip(time_s, np.full(50, 0.1), np.full(50, 1.0), 0.05)  # from rest in the contact
    >>> slip[[0, 2, -1]].round(3)
    array([0.   , 0.055, 0.1  ])
    """
    out = np.zeros_like(slip_speed_mps)
    for k in range(1, time_s.size):
        step_s = time_s[k] - time_s[k - 1]
        rate = 0.5 * (fastest_mps[k] + fastest_mps[k - 1]) / relaxation_m
        speed = 0.5 * (slip_speed_mps[k] + slip_speed_mps[k - 1]) / relaxation_m
        left = math.exp(-rate * step_s)
        gained = (1.0 - left) / rate if rate > 1e-6 else step_s
        out[k] = min(max(out[k - 1] * left + speed * gained, -1.0), 1.0)
    return out


def wheel_pull(
    run: RunLog, robot: Robot, track: StateTrack, table: MeasurementTable, slip: SlipTrack
) -> WheelPull:
    """Return what each wheel of a run pulled.

    Parameters
    ----------
    run : log of a swerve robot with motor currents and an IMU
    robot : its description, all sections
    track, table, slip : what a filter with slip speeds (``vio15``) made of the run, and of which measurements

    Raises
    ------
    ConfigError
        if the description lacks a section.
    DataError
        if the log has no motor currents or no IMU with roll and pitch, or the track no slip speeds.
    """
    body, motors, _, _, sensors = robot.equipment
    wheels = [f"current_{wheel}_a" for wheel in robot.wheels]
    _need(run, "wheels", [*wheels, *(f"motor_{wheel}_radps" for wheel in robot.wheels)])
    _need(run, "imu", ["roll_rad", "pitch_rad"])
    if "slip_speed_1_mps" not in track.states:
        raise DataError(f"run {run.run_id}: the track has no slip speeds: estimate it with vio15")
    clock, tau_s = track.time_s, sensors.encoder_time_constant_s
    told, imu = run.streams["wheels"], run.streams["imu"]
    current = np.column_stack(
        list(on_clock(clock, told.time_s, {name: told.channel(name) for name in wheels}, tau_s).values())
    )
    tilt = on_clock(
        clock,
        imu.time_s - sensors.imu_latency_s,
        {name: imu.channel(name) for name in ("roll_rad", "pitch_rad")},
        tau_s,
    )
    roll, pitch = tilt["roll_rad"], tilt["pitch_rad"]
    up = np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    accel = np.column_stack([track.state("accel_x_mps2"), track.state("accel_y_mps2"), np.zeros(clock.size)])
    force = GRAVITY_MPS2 * up + accel

    steer = np.column_stack([track.state(f"steer_{wheel}_rad") for wheel in robot.wheels])
    rate = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    twist = np.column_stack([track.state(name) for name in TWIST])
    along, across = wheel_frame_velocities(twist, robot.wheel_positions_m, steer)
    wheel_speed = rate * robot.wheel_radius_m
    slipping = wheel_speed - along
    fastest = np.maximum(np.abs(wheel_speed), np.abs(along))
    contact = np.column_stack(
        [contact_slip(clock, slipping[:, i], fastest[:, i], body.relaxation_length_m) for i in range(3)]
    )
    rolling = np.where(wheel_speed + along < 0.0, -1.0, 1.0)

    change = _smooth(np.gradient(rate, clock, axis=0), clock)
    torque = wheel_torque(
        current, motors.torque_constant_nmpa, motors.reduction_ratio, motors.efficiency_ratio
    )
    thrust = ground_thrust(
        torque, rate, change, motors.friction_nm, body.wheel_inertia_kgm2, robot.wheel_radius_m
    )
    load = wheel_loads(robot, force)

    speed = np.hypot(track.state("speed_x_mps"), track.state("speed_y_mps"))
    moving = speed > MIN_SPEED_MPS
    way = np.divide(
        np.column_stack([track.state("speed_x_mps"), track.state("speed_y_mps")]),
        speed[:, None],
        out=np.zeros((clock.size, 2)),
        where=moving[:, None],
    )
    cos_way = np.cos(steer) * way[:, :1] + np.sin(steer) * way[:, 1:]
    straight: Array = np.abs(across) < math.tan(MAX_SLIP_ANGLE_RAD) * np.abs(along)
    side = np.abs(across) / np.maximum(fastest, MIN_SPEED_MPS)
    oblique = (side >= SMALL_SLIP) & (side <= MAX_SIDE_RATIO * np.abs(contact))
    longer = np.where(oblique, np.hypot(1.0, side / np.where(oblique, contact, 1.0)), 1.0)
    slip_rate = np.abs(np.gradient(contact, clock, axis=0))
    with np.errstate(invalid="ignore"):
        thrust_rate = np.abs(_smooth(np.gradient(thrust, clock, axis=0), clock)) / np.maximum(
            robot.mass_kg * load, 1.0
        )
    standing = wheel_loads(robot, np.array([[0.0, 0.0, GRAVITY_MPS2]]))
    fresh = ~slip.stale & np.isfinite(track.reference_age_s)
    attitude = np.asarray(np.isfinite(load).all(axis=1))
    sound: dict[str, Array] = {
        "slip known": np.isfinite(slip.slip_ratio) & (slip.slip_std < MAX_SLIP_STD),
        "speed fresh": np.repeat(fresh[:, None], 3, axis=1),
        "moving": np.abs(along) > MIN_SPEED_MPS,
        "rolling straight": oblique | (side < SMALL_SLIP),
        "slip followed": slip_rate < MAX_SLIP_RATE_PS,
        "thrust followed": thrust_rate < MAX_THRUST_RATE_PS,
        "loaded": load > MIN_LOAD_SHARE * standing,
        "torque free": np.abs(torque) < MAX_TORQUE_SHARE * motors.torque_max_nm,
        "current known": np.isfinite(thrust),
        "attitude known": np.repeat(attitude[:, None], 3, axis=1),
    }
    balanced = (
        moving
        & fresh
        & (np.abs(twist[:, 2]) < MAX_YAW_RATE_RADPS)
        & straight.all(axis=1)
        & sound["current known"].all(axis=1)
        & attitude
    )
    noise_a = sensors.current_std_a * math.sqrt(_passed(clock, tau_s))
    per_amp = wheel_torque(
        np.ones(1), motors.torque_constant_nmpa, motors.reduction_ratio, motors.efficiency_ratio
    )
    return WheelPull(
        time_s=clock,
        slip_ratio=np.where(sound["slip known"], contact * rolling * longer, np.nan),
        slip_std=slip.slip_std,
        thrust_n=thrust * rolling * longer,
        load_npkg=load,
        speed_mps=fastest,
        pull_n=(thrust * cos_way).sum(axis=1),
        way_mps=speed,
        grade_mps2=GRAVITY_MPS2 * (up[:, :2] * way).sum(axis=1),
        normal_mps2=force[:, 2],
        thrust_std_n=float(noise_a * per_amp[0] / robot.wheel_radius_m),
        sound=sound,
        balanced=balanced,
    )


class Balance(NamedTuple):
    """Mass of the robot and resistance of its wheels over their load, each with one standard deviation."""

    mass_kg: float
    mass_std_kg: float
    resistance_ratio: float
    resistance_std: float


def body_balance(pull: WheelPull, robot: Robot, where: Array) -> Balance:
    """Return what the balance of the body along its way says of a run; resistance NaN where it says nothing.

    Parameters
    ----------
    pull : of the run
    robot : whose mass, :data:`MASS_STD_RATIO` about it, is believed beforehand
    where : (n,) on which ground

    Notes
    -----
    ``sum F = m (f + rho f_z)`` on means over :data:`BALANCE_S`, in which the ride averages out.  The mass is
    found by what changes from one mean to the next, by the changes of the acceleration a alone as an
    instrument, ``m = sum(da dF) / sum(da df)``: a is the speed gained over each mean and known well, while
    the attitude errs by the tilt of the body on rough ground, which would draw m down. What was believed of
    the mass before is weighed in.  Medians then give rho; an attitude wrong by :data:`TILT_STD_RAD` is part
    of its uncertainty.
    """
    blocks = _blocks(pull.time_s, pull.balanced & where, BALANCE_S)
    if len(blocks) < MIN_BLOCKS:
        return Balance(robot.mass_kg, robot.mass_kg * MASS_STD_RATIO, math.nan, math.nan)
    total, grade, normal = (
        np.array([values[block].mean() for block in blocks])
        for values in (pull.pull_n, pull.grade_mps2, pull.normal_mps2)
    )
    ends = [(block.start, block.stop - 1) for block in blocks]
    gained = np.array([pull.way_mps[b] - pull.way_mps[a] for a, b in ends])
    accel = gained / np.array([pull.time_s[b] - pull.time_s[a] for a, b in ends])
    force = grade + accel
    next_to = np.diff([block.start for block in blocks]) == blocks[0].stop - blocks[0].start
    d_total, d_force, d_accel = (np.diff(values)[next_to] for values in (total, force, accel))
    mass_kg, mass_std_kg = robot.mass_kg, robot.mass_kg * MASS_STD_RATIO
    with_force = float(d_accel @ d_force)
    found_kg = float(d_accel @ d_total) / with_force if with_force > 0.0 else math.nan
    # a robot that hardly changes its speed may come out at any mass, and by few changes seem sure of it
    if len(d_accel) >= MIN_BLOCKS and abs(found_kg - mass_kg) < MAX_MASS_STDS * mass_std_kg:
        rest = d_accel * (d_total - found_kg * d_force)
        found_std_kg = math.hypot(math.sqrt(float(rest @ rest)) / with_force, THRUST_STD_RATIO * found_kg)
        weight = mass_std_kg**2 / (mass_std_kg**2 + found_std_kg**2)
        mass_kg += weight * (found_kg - mass_kg)
        mass_std_kg = math.sqrt(weight) * found_std_kg
    ratio = (total / mass_kg - force) / normal
    rho = float(np.median(ratio))
    scatter = 1.4826 * float(np.median(np.abs(ratio - rho))) * math.sqrt(BALANCE_MEMORY / len(ratio))
    by_mass = mass_std_kg / mass_kg * abs(float(np.median(total / mass_kg / normal)))
    return Balance(mass_kg, mass_std_kg, rho, math.hypot(math.hypot(scatter, by_mass), TILT_STD_RAD))


def pull_samples(pull: WheelPull, mass_kg: float, where: Array, wheel_speed_std_mps: float) -> Array:
    """Return (k, 5) slip, its std, thrust over load, its std and its lag: means of one wheel.

    Means over :data:`SAMPLE_S` are taken before samples are sorted by their slip: a single slip errs by the
    ripple of Hall steps, and sorting by it would flatten a steep curve.  The lag is what the thrust changes
    within :data:`LAG_S`, to which thrust and slip are known to belong together; unlike the noise it is no
    smaller in many samples.

    Parameters
    ----------
    pull : of a run
    mass_kg : of the robot with what it carries
    where : (n,) on which ground
    wheel_speed_std_mps : scatter of a single wheel speed
    """
    rows = []
    believed = pull.believed
    for i in range(believed.shape[1]):
        for block in _blocks(pull.time_s, believed[:, i] & where, SAMPLE_S):
            load_n = float(pull.load_npkg[block, i].mean()) * mass_kg
            n, last = block.stop - block.start, block.stop - 1
            slip_std = wheel_speed_std_mps / (pull.speed_mps[block, i].mean() * math.sqrt(n))
            mean_std = float(np.mean(pull.slip_std[block, i]))
            rows.append(
                (
                    float(pull.slip_ratio[block, i].mean()),
                    math.hypot(slip_std, mean_std / math.sqrt(2.0)),
                    float(pull.thrust_n[block, i].mean()) / load_n,
                    pull.thrust_std_n / math.sqrt(n / 5.0) / load_n,
                    LAG_S
                    / SAMPLE_S
                    * abs(float(pull.thrust_n[last, i] - pull.thrust_n[block.start, i]))
                    / load_n,
                )
            )
    return np.array(rows).reshape(-1, 5)


def _blocks(time_s: Array, good: Array, length_s: float) -> list[slice]:
    """Return slices of that length in which every sample is good."""
    if time_s.size < 2:
        return []
    size = max(2, round(length_s / float(np.median(np.diff(time_s)))))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    return [
        slice(begin, begin + size)
        for first, last in edges.reshape(-1, 2)
        for begin in range(int(first), int(last) - size + 1, size)
    ]


def _need(run: RunLog, stream: str, channels: list[str]) -> None:
    held = run.streams[stream].channels if stream in run.streams else ()
    missing = [channel for channel in channels if channel not in held]
    if missing:
        raise DataError(f"run {run.run_id}: stream {stream!r} has no channel {missing[0]!r}")


def _smooth(values: Array, time_s: Array) -> Array:
    """Return a centred mean over :data:`RATE_SMOOTHING_S`."""
    half = round(0.5 * RATE_SMOOTHING_S / float(np.median(np.diff(time_s)))) if time_s.size > 1 else 0
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.asarray(np.mean([padded[i : i + len(values)] for i in range(2 * half + 1)], axis=0))


def _passed(time_s: Array, time_constant_s: float) -> float:
    """Return how much of the variance of white noise a low-pass lets through at this rate."""
    if time_constant_s <= 0 or time_s.size < 2:
        return 1.0
    keep = math.exp(-float(np.median(np.diff(time_s))) / time_constant_s)
    return (1.0 - keep) / (1.0 + keep)
