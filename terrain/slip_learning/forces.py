"""Thrust, load and slip of each wheel over a run, its mass and resistance, and bins of slip: what a curve is fitted to.

**Forces.**  Of wheel i, with its rate w, radius r, inertia J, the current I of its motor, the robot's mass m and
its specific force f = a + g up (the reading of an ideal accelerometer)::

    T = I kt n eta                                       torque at the wheel
    F = (T - T_friction tanh(w / w_0) - J dw/dt) / r     thrust of the terrain
    N = m (q_i f_z - h (G_i . (f_x, f_y)))               load: three contacts under a rigid body

The torque constant kt, the reduction n and the efficiency eta are those of the robot's description.  The
efficiency is taken as one factor between current and torque, driving and driven alike, as in
:mod:`terrain.simulation.sensors`; with a reduction that is driven by its wheel it is reversed, so that
braking forces of a real robot come out too small by about its square.

Slips have passed the encoders' low-pass filter, the current has not: everything goes through the same filter.

**Slip of the contact.**  Thrust follows the slip only over the relaxation length sigma of the contact (Pacejka,
Tyre and Vehicle Dynamics, 7.2.1), so that in a start it belongs to a slip of a moment ago.  The slip given here is
that of the contact, u / sigma with ``du/dt = (w r - v) - max(|w r|, |v|) u / sigma``; in steady motion it is the
slip ratio.  Terrain is taken as isotropic (:mod:`terrain.terramechanics.traction`): the force of a wheel that also
slips sideways, as on a cross slope, is along the slip vector.  Its sample is the magnitude of that vector and of
the force.

**Balance.**  With the thrusts F of the wheels, the specific force f along the direction of travel (acceleration and
grade), the specific force f_z normal to the terrain, the mass m and the resistance over load rho::

    sum F = m (f + rho f_z)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from terrain.constants import GRAVITY_MPS2
from terrain.errors import DataError
from terrain.estimation.feed import MeasurementTable, on_clock
from terrain.kernels import njit
from terrain.kinematics.wheels import wheel_frame_velocities
from terrain.logs.schema import TWIST
from terrain.records import Array, Label, RunLog, SlipTrack, StateTrack
from terrain.robots import Robot
from terrain.signals import true_stretches

MIN_SPEED_MPS = 0.2  #: At lower speeds, an error of 1 cm/s in the speed is over 5 % of slip
MAX_SIDE_RATIO = 0.5  #: Lateral over longitudinal slip above which a wheel's longitudinal thrust is not used
SMALL_SLIP = 0.02  #: Lateral slip up to which the reduction of the longitudinal thrust is negligible


@njit
def contact_slip(
    time_s: Array, slip_speed_mps: Array, reference_speed_mps: Array, relaxation_m: float
) -> Array:
    """Return the slip (n,) of a contact that follows the slip velocity over its relaxation length.

    ``slip_speed_mps`` (n,) is w r - v, ``reference_speed_mps`` (n,) the larger magnitude of w r and v.

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
        rate = 0.5 * (reference_speed_mps[k] + reference_speed_mps[k - 1]) / relaxation_m
        speed = 0.5 * (slip_speed_mps[k] + slip_speed_mps[k - 1]) / relaxation_m
        left = math.exp(-rate * step_s)
        gained = (1.0 - left) / rate if rate > 1e-6 else step_s
        out[k] = min(max(out[k - 1] * left + speed * gained, -1.0), 1.0)
    return out


MAX_SLIP_STD = 0.05  #: A less certain slip carries no information on a curve that rises within 0.1 to 0.3

MAX_SLIP_ANGLE_RAD = 0.15
"""For the balance: the components of side forces along the direction of travel are then within a ninth."""

MAX_YAW_RATE_RADPS = 0.1  #: For the balance, which leaves side forces out

MIN_LOAD_RATIO = 0.35
"""Load relative to that of the standing robot below which a wheel is about to lift and its F / N is noise."""

MAX_TORQUE_RATIO = 0.985
"""A motor at its torque limit gives the same thrust on good and on bad spots, and slips more on the bad: such
samples would bend the curve down."""

MAX_SLIP_RATE_PS = 3.0
"""Slip that changes faster is smeared by the 50 ms of the low-pass filter over more than 0.15."""

MAX_THRUST_RATE_PS = 1.0  #: Thrust over load that changes faster belongs to a slip that is not known to 50 ms
LABEL_EDGE_S = 0.3  #: After this the low-pass filter holds e^-6 of the terrain before, which is negligible
FRICTION_RATE_RADPS = 0.1  #: Rate over which bearing friction takes its full value, as in the simulation
RATE_SMOOTHING_S = 0.06  #: Centred mean under the wheel's acceleration: Hall steps and noise of three samples


class WheelForces(NamedTuple):
    """Thrust, load and slip of each wheel over a run; positive in traction, forward or in reverse."""

    time_s: Array  #: (n,) clock of the wheels
    #: slip_ratio, slip_std: (n, wheels) of the contact, its lateral part included; NaN where unknown
    slip_ratio: Array
    slip_std: Array
    thrust_n: Array  #: (n, wheels) force of the terrain along that slip, before any resistance
    load_npkg: Array  #: (n, wheels) load over the robot's mass
    #: (n, wheels) denominator of the slip, the larger of wheel circumferential speed and speed over ground
    reference_speed_mps: Array
    total_thrust_n: Array  #: (n,) sum of the thrusts along the direction of travel
    speed_mps: Array  #: (n,) of the body over ground
    grade_mps2: Array  #: (n,) component of gravity against the direction of travel: uphill positive
    normal_mps2: Array  #: (n,) specific force normal to the terrain
    thrust_std_n: float  #: of one thrust, by the noise of the current
    conditions: Mapping[str, Array]  #: by name, whether (n, wheels) a sample meets a condition of its use
    balance_valid: Array  #: (n,) whether an instant may be used in the balance of the body

    @property
    def valid(self) -> Array:
        """Whether (n, wheels) every one of :attr:`conditions` holds."""
        return np.asarray(np.logical_and.reduce(list(self.conditions.values())))

    def on_terrain(self, labels: tuple[Label, ...], terrain: str) -> Array:
        """Return where (n,) a label names this terrain, without :data:`LABEL_EDGE_S` after a change."""
        inside = np.zeros(self.time_s.size, dtype=bool)
        for start_s, end_s, name in labels:
            if name == terrain:
                begin = start_s + (LABEL_EDGE_S if start_s > self.time_s[0] else 0.0)
                inside |= (self.time_s >= begin) & (self.time_s < end_s)
        return inside


def wheel_loads(robot: Robot, force_mps2: Array) -> Array:
    """Return the load of each wheel over the robot's mass, (n, 3) N/kg, for the body's specific force (n, 3).

    Three contacts carry a rigid body: the loads follow from the balance of forces and of the two moments.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> standing = np.array([[0.0, 0.0, 9.0], [1.0, 0.0, 9.0]])  # the second speeds up or climbs
    >>> wheel_loads(load_robot("agrimaro"), standing).round(2)
    array([[3.  , 3.  , 3.  ],
           [3.49, 2.51, 3.  ]])
    """
    body = robot.body
    inverse = np.linalg.inv(np.vstack([np.ones(3), robot.wheel_positions_m.T]))
    load_ratio = inverse @ np.array([1.0, body.com_x_m, body.com_y_m])
    return np.asarray(
        force_mps2[:, 2:] * load_ratio - body.com_height_m * force_mps2[:, :2] @ inverse[:, 1:].T
    )


def wheel_forces(
    run: RunLog, robot: Robot, track: StateTrack, table: MeasurementTable, slip: SlipTrack
) -> WheelForces:
    """Return thrust, load and slip of each wheel of a run.

    Raises
    ------
    ConfigError
        if the description lacks a section.
    DataError
        if the log has no motor currents or no IMU with roll and pitch, or the track no slip speeds.
    """
    robot.require(*robot.sections)
    currents, rates = ([name.format(w) for w in robot.wheels] for name in ("current_{}_a", "motor_{}_radps"))
    attitude = ["roll_rad", "pitch_rad"]
    for stream, channels in (("wheels", currents + rates), ("imu", attitude)):
        present = run.streams[stream].channels if stream in run.streams else ()
        missing = [channel for channel in channels if channel not in present]
        if missing:
            raise DataError(f"run {run.run_id}: stream {stream!r} has no channel {missing[0]!r}")
    if "slip_speed_1_mps" not in track.states:
        raise DataError(f"run {run.run_id}: the track has no slip speeds: estimate it with vio15")
    clock, sensors, motors, body = track.time_s, robot.sensors, robot.motors, robot.body
    imu, wheels, lag_s = run.streams["imu"], run.streams["wheels"], sensors.encoder_time_constant_s
    angles = {name: imu.channel(name) for name in attitude}
    roll, pitch = on_clock(clock, imu.time_s - sensors.imu_latency_s, angles, lag_s).values()
    up = np.column_stack([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
    accel = [track.state("accel_x_mps2"), track.state("accel_y_mps2"), np.zeros(clock.size)]
    force = GRAVITY_MPS2 * up + np.column_stack(accel)
    steer = np.column_stack([track.state(f"steer_{wheel}_rad") for wheel in robot.wheels])
    rate = table.columns([f"wheel_{wheel}_radps" for wheel in robot.wheels])
    twist = np.column_stack([track.state(name) for name in TWIST])
    forward, left = wheel_frame_velocities(twist, robot.wheel_positions_m, steer)
    wheel_speed = rate * robot.wheel_radius_m
    reference = np.maximum(np.abs(wheel_speed), np.abs(forward))
    pairs = zip((wheel_speed - forward).T, reference.T, strict=True)
    along_slip = np.column_stack([contact_slip(clock, *pair, body.relaxation_length_m) for pair in pairs])
    side_slip = np.abs(left) / np.maximum(reference, MIN_SPEED_MPS)
    oblique = (side_slip >= SMALL_SLIP) & (side_slip <= MAX_SIDE_RATIO * np.abs(along_slip))
    # length of the slip vector over its longitudinal component, negative where a wheel rolls back
    rolling = np.where(wheel_speed + forward < 0.0, -1.0, 1.0)
    factor = rolling * np.where(oblique, np.hypot(1.0, side_slip / np.where(oblique, along_slip, 1.0)), 1.0)
    speed = np.hypot(*twist[:, :2].T)
    moving = speed > MIN_SPEED_MPS
    along = np.divide(twist[:, :2], speed[:, None], out=np.zeros_like(twist[:, :2]), where=moving[:, None])
    filtered = on_clock(clock, wheels.time_s, {name: wheels.channel(name) for name in currents}, lag_s)
    torque = np.column_stack(list(filtered.values())) * motors.nm_per_a
    friction = motors.friction_nm * np.tanh(rate / FRICTION_RATE_RADPS)
    wheel_accel = _smooth(np.gradient(rate, clock, axis=0), clock)
    thrust = (torque - friction - body.wheel_inertia_kgm2 * wheel_accel) / robot.wheel_radius_m
    load, standing = (wheel_loads(robot, each) for each in (force, np.array([[0.0, 0.0, GRAVITY_MPS2]])))
    fresh = ~slip.stale & np.isfinite(track.reference_age_s)
    with np.errstate(invalid="ignore"):
        thrust_change = np.abs(_smooth(np.gradient(thrust, clock, axis=0), clock))
        thrust_rate = thrust_change / np.maximum(robot.mass_kg * load, 1.0)
    conditions = {
        "slip known": np.isfinite(slip.mean) & (slip.std < MAX_SLIP_STD),
        "speed fresh": np.repeat(fresh[:, None], 3, axis=1),
        "moving": np.abs(forward) > MIN_SPEED_MPS,
        "rolling straight": oblique | (side_slip < SMALL_SLIP),
        "slip followed": np.abs(np.gradient(along_slip, clock, axis=0)) < MAX_SLIP_RATE_PS,
        "thrust followed": thrust_rate < MAX_THRUST_RATE_PS,
        "loaded": load > MIN_LOAD_RATIO * standing,
        "torque free": np.abs(torque) < MAX_TORQUE_RATIO * motors.torque_max_nm,
        "current known": np.isfinite(thrust),
        "attitude known": np.isfinite(load).all(axis=1, keepdims=True).repeat(3, axis=1),
    }
    straight = np.abs(left) < math.tan(MAX_SLIP_ANGLE_RAD) * np.abs(forward)
    balanced = moving & fresh & (np.abs(twist[:, 2]) < MAX_YAW_RATE_RADPS)
    known = straight & conditions["current known"] & conditions["attitude known"]
    noise_a = sensors.current_std_a
    if lag_s > 0 and clock.size > 1:  # of white noise behind a low-pass filter at this rate
        remaining = math.exp(-float(np.median(np.diff(clock))) / lag_s)
        noise_a *= math.sqrt((1.0 - remaining) / (1.0 + remaining))
    cos_along = np.cos(steer) * along[:, :1] + np.sin(steer) * along[:, 1:]
    return WheelForces(
        time_s=clock,
        slip_ratio=np.where(conditions["slip known"], along_slip * factor, np.nan),
        slip_std=slip.std,
        thrust_n=thrust * factor,
        load_npkg=load,
        reference_speed_mps=reference,
        total_thrust_n=(thrust * cos_along).sum(axis=1),
        speed_mps=speed,
        grade_mps2=GRAVITY_MPS2 * (up[:, :2] * along).sum(axis=1),
        normal_mps2=force[:, 2],
        thrust_std_n=noise_a * motors.nm_per_a / robot.wheel_radius_m,
        conditions=conditions,
        balance_valid=balanced & known.all(axis=1),
    )


def _smooth(values: Array, time_s: Array) -> Array:
    """Return a centred mean over :data:`RATE_SMOOTHING_S`."""
    half = round(0.5 * RATE_SMOOTHING_S / float(np.median(np.diff(time_s)))) if time_s.size > 1 else 0
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    return np.asarray(np.mean([padded[i : i + len(values)] for i in range(2 * half + 1)], axis=0))


def valid_intervals(time_s: Array, valid: Array, length_s: float) -> list[slice]:
    """Return consecutive slices of one length in which every sample is valid.

    Examples
    --------
    >>> valid = np.array([True, True, True, False, True, True, True, True])
    >>> valid_intervals(np.arange(8) * 0.1, valid, 0.2)
    [slice(0, 2, None), slice(4, 6, None), slice(6, 8, None)]
    """
    if time_s.size < 2:
        return []
    size = max(2, round(length_s / float(np.median(np.diff(time_s)))))
    return [
        slice(begin, begin + size)
        for first, end in true_stretches(valid).tolist()
        for begin in range(first, end - size + 1, size)
    ]


BALANCE_S = 0.5  #: Length of a mean; vertical oscillation of the body at 7 Hz averages out
CORRELATED_MEANS = 4.0  #: Means whose errors are alike, over 2 s of terrain
MIN_MEANS = 4  #: Fewer means are too few for a median

THRUST_STD_RATIO = 0.03
"""Error that all thrusts of a run share: of the torque constant with the motor's temperature, and of currents
that are sampled in step with the commands."""

MASS_STD_RATIO = 0.15
"""Prior of the mass, relative to the described robot: payloads up to a third of it (data/spread)."""

MAX_MASS_STDS = 4.0  #: A mass further than this from its prior is not used: outside 36 to 144 kg for 90

TILT_STD_RAD = 0.01
"""Error of a grade by the attitude: mounting, and the body's tilt on its springs and on rough terrain."""


class Balance(NamedTuple):
    """Mass of the robot and resistance of its wheels over their load, each with one standard deviation."""

    mass_kg: float
    mass_std_kg: float
    resistance_ratio: float
    resistance_std: float


def body_balance(forces: WheelForces, robot: Robot, where: Array) -> Balance:
    """Return mass and resistance of a run; the resistance is NaN where there are too few means.

    Parameters
    ----------
    forces : of the run
    robot : whose mass, with a standard deviation of :data:`MASS_STD_RATIO`, is the prior
    where : (n,) whether an instant is on the terrain

    Notes
    -----
    The mass is its prior combined with what changes from one mean to the next, with the changes of the acceleration a
    as the instrument, ``m = sum(da dF) / sum(da df)``: a is the speed gained over each mean and known well,
    while the attitude has the error of the body's tilt on rough terrain, which would bias m to low values.
    Medians give rho; an attitude wrong by :data:`TILT_STD_RAD` is part of its uncertainty.
    """
    parts = valid_intervals(forces.time_s, forces.balance_valid & where, BALANCE_S)
    mass_kg, mass_std_kg = robot.mass_kg, robot.mass_kg * MASS_STD_RATIO
    if len(parts) < MIN_MEANS:
        return Balance(mass_kg, mass_std_kg, math.nan, math.nan)
    thrust_n, grade, normal = (
        np.array([values[part].mean() for part in parts])
        for values in (forces.total_thrust_n, forces.grade_mps2, forces.normal_mps2)
    )
    first, last = np.array([(part.start, part.stop - 1) for part in parts]).T
    gained_mps = forces.speed_mps[last] - forces.speed_mps[first]
    accel = gained_mps / (forces.time_s[last] - forces.time_s[first])
    consecutive = np.diff(first) == parts[0].stop - parts[0].start
    d_thrust, d_force, d_accel = (np.diff(v)[consecutive] for v in (thrust_n, grade + accel, accel))
    covariation = float(d_accel @ d_force)
    found_kg = float(d_accel @ d_thrust) / covariation if covariation > 0.0 else math.nan
    # a robot that hardly changes its speed may come out at any mass, with a small error from few changes
    if len(d_accel) >= MIN_MEANS and abs(found_kg - mass_kg) < MAX_MASS_STDS * mass_std_kg:
        residual = d_accel * (d_thrust - found_kg * d_force)
        scatter_kg = math.sqrt(float(residual @ residual)) / covariation
        found_std_kg = math.hypot(scatter_kg, THRUST_STD_RATIO * found_kg)
        weight = mass_std_kg**2 / (mass_std_kg**2 + found_std_kg**2)
        mass_kg, mass_std_kg = mass_kg + weight * (found_kg - mass_kg), math.sqrt(weight) * found_std_kg
    ratio = (thrust_n / mass_kg - (grade + accel)) / normal
    rho = float(np.median(ratio))
    scatter = 1.4826 * float(np.median(np.abs(ratio - rho))) * math.sqrt(CORRELATED_MEANS / len(ratio))
    by_mass = mass_std_kg / mass_kg * abs(float(np.median(thrust_n / mass_kg / normal)))
    return Balance(mass_kg, mass_std_kg, rho, math.hypot(math.hypot(scatter, by_mass), TILT_STD_RAD))


SAMPLE_S = 0.2
"""Length of a sample: ten of the wheels' own, which reduces the ripple of Hall steps to a third."""

LAG_S = 0.02  #: One sampling period of the wheels: to this is known which slip a thrust belongs to

BIN_EDGES = (
    *(-0.02, 0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.09, 0.12, 0.15, 0.18, 0.21, 0.24, 0.27),
    *(0.3, 0.34, 0.38, 0.42, 0.46, 0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95, 1.0),
)
"""Bins of slip: narrow where the curve of hard terrain bends."""

MIN_IN_BIN = 2  #: Samples that make a bin

BIN_STD_RATIO, BIN_STD = 0.03, 0.003
"""Error of the mean of even a full bin, relative to its thrust and as thrust over load: terrain varies along
the path by 3 % (data/soils), and no law is exact.  It keeps bins with many samples from dominating."""


class TractionSamples(NamedTuple):
    """Samples of one run on one terrain, (k,) each."""

    slip_ratio: Array  #: slip_ratio, slip_std: of the contact
    slip_std: Array
    traction_ratio: Array  #: traction_ratio, traction_std: thrust over load
    traction_std: Array
    #: change of the thrust over load within :data:`LAG_S`; unlike noise it does not average out
    lag_std: Array


class RunBins(NamedTuple):
    """Bins of slip of one run: mean slip, its std, mean thrust over load, its std; (k,) each."""

    run_id: str
    slip_ratio: Array
    slip_std: Array
    traction_ratio: Array
    traction_std: Array
    session: str = ""


def traction_samples(
    forces: WheelForces, mass_kg: float, where: Array, wheel_speed_std_mps: float
) -> TractionSamples:
    """Return means over :data:`SAMPLE_S`, of one wheel each.

    Parameters
    ----------
    forces : of a run
    mass_kg : of the robot with its payload
    where : (n,) whether an instant is on the terrain
    wheel_speed_std_mps : standard deviation of a single wheel speed

    Notes
    -----
    Means are taken before samples are sorted by slip: a single slip has the error of the ripple of Hall
    steps, and sorting by it would flatten a steep curve.
    """
    rows, valid = [], forces.valid
    for i in range(valid.shape[1]):
        for part in valid_intervals(forces.time_s, valid[:, i] & where, SAMPLE_S):
            load_n, n = float(forces.load_npkg[part, i].mean()) * mass_kg, part.stop - part.start
            noise_std = wheel_speed_std_mps / (forces.reference_speed_mps[part, i].mean() * math.sqrt(n))
            mean_std = float(np.mean(forces.slip_std[part, i]))
            thrust_n = forces.thrust_n[part, i]
            rows.append(
                (
                    float(forces.slip_ratio[part, i].mean()),
                    math.hypot(noise_std, mean_std / math.sqrt(2.0)),
                    float(thrust_n.mean()) / load_n,
                    forces.thrust_std_n / math.sqrt(n / 5.0) / load_n,
                    LAG_S / SAMPLE_S * abs(float(thrust_n[-1] - thrust_n[0])) / load_n,
                )
            )
    return TractionSamples(*np.array(rows).reshape(-1, 5).T)


def run_bins(run_id: str, samples: TractionSamples, session: str = "") -> RunBins:
    """Return the bins of one run's samples that hold :data:`MIN_IN_BIN` or more."""
    bin_number = np.digitize(samples.slip_ratio, BIN_EDGES)
    rows = []
    for number in range(1, len(BIN_EDGES)):
        inside = bin_number == number
        n = int(inside.sum())
        if n < MIN_IN_BIN:
            continue
        slip, slip_std, traction, traction_std, lag_std = (column[inside] for column in samples)
        residual = traction - traction.mean()
        scatter = float(np.sqrt((residual @ residual) / (n - 1) / n))
        floor = BIN_STD + BIN_STD_RATIO * abs(float(traction.mean()))
        noise = max(scatter, float(traction_std.mean()) / math.sqrt(n))
        std = math.hypot(noise, floor, float(lag_std.mean()))
        slip_mean_std = math.sqrt(float((slip_std**2).mean()) / n)
        rows.append((slip.mean(), slip_mean_std, traction.mean(), std))
    slip, slip_std, traction, traction_std = np.array(rows).reshape(-1, 4).T
    return RunBins(run_id, slip, slip_std, traction, traction_std, session)


def slip_range(runs: Sequence[RunBins]) -> tuple[float, float]:
    """Return the smallest and the largest slip that two runs or more reach; NaN where no two runs have bins.

    Examples
    --------
    >>> def bins(*slips):
    ...     return RunBins("r", np.array(slips), *np.zeros((3, len(slips))))
    >>> slip_range([bins(0.01, 0.3), bins(0.05, 0.5), bins(0.03, 0.4)])
    (0.03, 0.4)
    """
    with_bins = [run.slip_ratio for run in runs if len(run.slip_ratio)]
    if len(with_bins) < 2:
        return math.nan, math.nan
    low, high = sorted(min(s) for s in with_bins)[1], sorted(max(s) for s in with_bins)[-2]
    return max(0.0, float(low)), float(high)
