r"""Tracks on an even slope: forces under two tracks, or slip that is prescribed, and one run of them.

The belts follow the commanded speeds with a lag; the motion is that on soils or with prescribed slip, one after the
other; sensors add noise.  Poses are those of cameras around the field, positions of satellites are raw, and a compass
shows the heading.

**Forces.** A body moves by :math:`(V_x, V_y, w)`; a track at :math:`y = \pm d` with the belt speed v touches
down at its front, :math:`x = l/2`, where v > 0, and at its rear where v < 0.  An element that lies :math:`\xi` behind
that end has been on the ground for :math:`t = \xi / |v|`; it slides with :math:`s` and has slid :math:`j`:

.. math::
    s = (v - V_x + w y,\; -(V_y + w x)), \qquad
    j = t\,(v - V_x + w y,\; -(V_y + w \bar x)),

:math:`\bar x` being the middle of where it has been.  The shear stress has the direction of s and the size

.. math:: \tau = (c + p \tan\varphi)(1 - e^{-|j|/K})

(Wong and Chiang, A general theory for skid steering of tracked vehicles on firm ground, 2001; Janosi and
Hanamoto 1961).  In straight motion the sum over a track is Tazzari (7) and the right form of Yamauchi (17).

The pressure p is linear along a track and differs from track to track: gravity on a slope acts at the height
of the centre of mass.  Each track presses a rut (compaction, Bekker), rolls against its own friction, and
pushes soil aside with its sides at their depth z: passive earth pressure
:math:`\gamma z^2 K_p / 2 + 2 c z \sqrt{K_p}` on each metre that slides sideways, mobilised by how far it has.
**Bulldozing on the inner side**: what a turning robot sweeps into the turn lies beside the inner track (of a
turn in place, half beside each) and adds to its depth there, :math:`z^2 + 2 A`; the cross-section A of that
heap grows by what is swept and is left behind as the robot moves on,
:math:`dA/dt = z |w| l / 4 - A |V_x| / l` (this project's; Yamauchi et al. describe the heap, fig. 19, and do
not model it).

What is assumed: loads follow gravity alone, not accelerations; a belt that does not turn counts as creeping
with :data:`CREEP_MPS`, so that a stopped track is dragged at its full friction; unit weight of soil and
mobilisation of the earth pressure are constants.

**Motion** is a balance of forces with inertia, stepped implicitly,

.. math:: M (V^+ - V)/h + M\,(-w V_y,\; w V_x,\; 0) = F(V^+),

F being the forces.  They change with the slip over the belt's speed, within a millimetre of travel, which no
explicit step of a hundredth of a second follows; the implicit one is solved by Newton's method with a numerical
Jacobian, halved where the residual grows, and stands still on a slope without inertia of its own.

**Prescribed slip** stands in place of a soil: what papers assume, with numbers that an estimator has to find.
With the belts' speeds :math:`v_l, v_r`, the grade g along the motion and the roll h,

.. math::
    \alpha &= a_0 + a_1 g, \qquad v_i' = \eta_i (1 - \alpha)\, v_i, \\
    D &= k\,(v_r' - v_l'), \qquad u_r = D\,\frac{a}{a + b}, \quad u_l = -D\,\frac{b}{a + b}, \\
    V_x &= \tfrac12 (v_r' - u_r + v_l' - u_l), \quad
    w = \frac{v_r' - v_l' - D}{2 d}, \quad V_y = -|V_x|\, c\, h,

with :math:`a = |v_r'|^{1-n}`, :math:`b = |v_l'|^{1-n}` for :math:`n \le 1` and
:math:`a = |v_l'|^{n-1}, b = |v_r'|^{n-1}` beyond: Tazzari (5), Yamauchi (22) and (26), and Endo's law
(Yamauchi (27)) written without its singular points.  k is how much of the difference is lost in turning.

**Slope.** Positions and headings are those in the plane of the slope.  With its angle s and the heading q of uphill, a
body at the heading h has ``sin(grade) = sin s cos(h - q)``, uphill positive, and, as ZYX angles,
``sin(roll) = -sin s sin(h - q) / cos(grade)``, left side up positive; then ``cos(roll) cos(grade) = cos s``,
Yamauchi (29).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.kernels import filled, inner, njit, numbers, record
from terrain.kinematics.commands import wheel_motion
from terrain.logs.schema import IMU_CHANNELS, POSE_CHANNELS
from terrain.records import Array, Label, Stream
from terrain.robots import Robot, TrackedRobot, as_drive
from terrain.simulation import sensors as sensing
from terrain.simulation.scenario import RATE_HZ, Conditions, Scenario
from terrain.simulation.sensors import BODY, RAW_HZ
from terrain.slip import slip_angle, slip_ratio
from terrain.terramechanics.soil import Soil
from terrain.terramechanics.traction import compaction_resistance, plate_sinkage

STEP_S = 0.01  # from step to step; no sensor is sampled faster
# Newton steps, halvings of each, and the residual over the weight at which the balance is reached.
ITERATIONS, HALVINGS, TOLERANCE = 60, 40, 1e-8
NUDGE = 1e-7  # change of a speed, in m/s, over which the Jacobian is taken
ELEMENTS = 16  # elements along a track: forces are within 1 % of those of 200
# Belt speed that a stopped track counts as having, sliding speed below which friction has no direction of its own,
# and speed over which resistances against motion take their full size.
CREEP_MPS, SLIDING_MPS, ROLLING_MPS = 1e-3, 1e-5, 2e-3
# Of loose dry sand: 14 to 16 kN/m^3 (Terzaghi, Peck and Mesri, Soil Mechanics in Engineering Practice).
UNIT_WEIGHT_NPM3 = 15000.0
# Sideways distance over which the earth pressure builds up; assumed, as the shear modulus of loose sand.
MOBILISED_M = 0.02


class PrescribedSlip(NamedTuple):
    """Slip of the two tracks; none by default."""

    eta_left_ratio: float = 1.0  # ground speed over belt speed
    eta_right_ratio: float = 1.0
    slip_ratio: float = 0.0  # a_0, of straight motion on the level, positive in traction
    grade_slip_ratio: float = 0.0  # a_1, a rad of grade along the motion
    side_slip_ratio: float = 0.0  # c, slip angle a rad of roll
    turning_loss_ratio: float = 0.0  # k
    turning_exponent: float = 1.0  # n of Endo's law


class Stretch(NamedTuple):
    """A soil that shears, or the slip itself, and the distance travelled on it; a run's last one goes on for ever."""

    ground: Soil | PrescribedSlip
    length_m: float = math.inf


TrackedGround = Soil | PrescribedSlip | Sequence[Stretch]


class Slope(NamedTuple):
    """An even slope: its angle against the horizontal, and the heading of uphill in its plane; level by default."""

    angle_rad: float = 0.0
    uphill_rad: float = 0.0


LEVEL = Slope()

TRACKS = record(
    numbers(
        "half_m length_m width_m height_m mass_kg inertia_kgm2 area_m2 cohesion_pa tan_friction "
        "shear_modulus_m kc_npmn1 kphi_npmn2 exponent_ratio rolling_ratio passive_ratio until_m"
    )
    | dict.fromkeys(PrescribedSlip._fields, float)
    | {"sheared": bool}
)
"""A robot on a ground: its numbers, those of a soil that is sheared or of prescribed slip, and the distance travelled
at which the ground ends."""

STATE = record(
    numbers("position_x_m position_y_m yaw_rad speed_x_mps speed_y_mps yaw_rate_radps heap_m2 travelled_m")
)
"""Pose in the plane of the slope, twist, cross-section of the heap beside the inner track, and distance."""


@njit
def tilt_at(angle_rad: float, uphill_rad: float, yaw_rad: float) -> tuple[float, float]:
    """Return grade and roll of a body on a slope.

    Examples
    --------
    >>> grade, roll = tilt_at(0.2, math.pi / 2, 0.0)  # uphill is to the left: the left side is up
    >>> abs(round(grade, 6)), round(roll, 6)
    (0.0, 0.2)
    """
    grade = math.asin(math.sin(angle_rad) * math.cos(yaw_rad - uphill_rad))
    side = -math.sin(angle_rad) * math.sin(yaw_rad - uphill_rad) / math.cos(grade)
    return grade, math.asin(min(max(side, -1.0), 1.0))


def tracks_on(robot: TrackedRobot, ground: Soil | PrescribedSlip, until_m: float = math.inf) -> Array:
    """Return a robot on a ground, (1,) of :data:`TRACKS`.

    Parameters
    ----------
    robot : its yaw inertia is that of an even plate over the tracks
    ground : a soil that shears, without Bekker's numbers no rut is pressed and nothing is pushed aside; or the slip
        itself
    until_m : distance travelled at which the ground ends

    Raises
    ------
    ConfigError
        if the soil does not shear.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> from terrain.terramechanics.soil import load_soil
    >>> tracks_on(load_robot("patako"), load_soil("dry_sand"))["half_m"].round(4)
    array([0.1965])
    """
    across_m, names = robot.track_m + robot.track_width_m, TRACKS.names or ()
    described = {n: getattr(part, n) for part in (robot, ground) for n in names if hasattr(part, n)} | {
        "half_m": robot.half_track_m,
        "length_m": robot.contact_length_m,
        "width_m": robot.track_width_m,
        "height_m": robot.com_height_m,
        "inertia_kgm2": robot.mass_kg * (robot.contact_length_m**2 + across_m**2) / 12.0,
        "area_m2": robot.contact_length_m * robot.track_width_m,
        "until_m": until_m,
    }
    if isinstance(ground, PrescribedSlip):
        return filled(TRACKS, **described)
    if ground.law != "janosi":
        raise ConfigError(
            f"soil {ground.name!r} has the law {ground.law!r}: a tracked robot is simulated on ground that "
            "shears, the law 'janosi'"
        )
    described |= {
        "sheared": True,
        "tan_friction": math.tan(ground.friction_angle_rad),
        "rolling_ratio": ground.rolling_resistance_ratio,
        "passive_ratio": math.tan(math.pi / 4 + ground.friction_angle_rad / 2) ** 2,
        "exponent_ratio": ground.sinkage_exponent_ratio,
    }
    if not math.isfinite(ground.kphi_npmn2):  # no rut is pressed, and nothing pushed aside
        described |= dict.fromkeys(("kc_npmn1", "kphi_npmn2", "exponent_ratio"), 0.0)
    return filled(TRACKS, **described)


@njit
def track_loads(tracks: Any, grade_rad: float, roll_rad: float) -> tuple[float, float, float]:
    """Return the loads of the left and the right track, and how far ahead of the middle they act.

    A track that would lift carries nothing, and the load acts within the middle third, so that no pressure
    is negative.
    """
    weight = tracks.mass_kg * GRAVITY_MPS2
    normal = weight * math.cos(grade_rad) * math.cos(roll_rad)
    along, across = -weight * math.sin(grade_rad), -weight * math.sin(roll_rad) * math.cos(grade_rad)
    shift = across * tracks.height_m / (2.0 * tracks.half_m)
    left = min(max(0.5 * normal + shift, 0.0), normal)
    ahead = along * tracks.height_m / max(normal, 1e-9)
    third = tracks.length_m / 6.0
    return left, normal - left, min(max(ahead, -third), third)


@njit
def rut_depth(tracks: Any, load_n: float) -> float:
    """Return the depth of a track's rut; 0 on ground that has no numbers of sinkage."""
    if tracks.kphi_npmn2 == 0.0:
        return 0.0
    pressure = load_n / tracks.area_m2
    return float(
        plate_sinkage(pressure, tracks.width_m, tracks.kc_npmn1, tracks.kphi_npmn2, tracks.exponent_ratio)
    )


@njit
def track_forces(
    tracks: Any, belt_mps: Array, twist: Array, grade_rad: float, roll_rad: float, heap_m2: float, out: Array
) -> None:
    """Write the force along x, that along y and the moment (3,) of the ground and of gravity on the body.

    Belts are left and right, (2,); the twist (3,) is in body axes; grade and roll are uphill and left side up positive.
    """
    weight = tracks.mass_kg * GRAVITY_MPS2
    out[0], out[1] = -weight * math.sin(grade_rad), -weight * math.sin(roll_rad) * math.cos(grade_rad)
    out[2] = 0.0
    left, right, ahead_m = track_loads(tracks, grade_rad, roll_rad)
    length, passive = tracks.length_m, tracks.passive_ratio
    step = length / ELEMENTS
    for side in range(2):
        belt, load_n = belt_mps[side], left if side == 0 else right
        y = tracks.half_m if side == 0 else -tracks.half_m
        front = 0.5 * length if belt >= 0.0 else -0.5 * length
        creep = max(abs(belt), CREEP_MPS)
        along = belt - twist[0] + twist[2] * y
        # force on each metre of a side that pushes soil of the rut's depth, and of the heap on it
        depth = rut_depth(tracks, load_n)
        cohesive = 2.0 * tracks.cohesion_pa * depth * math.sqrt(passive)
        square, heap = depth * depth, 2.0 * (inner_share(twist, y) * heap_m2)
        flank = 0.5 * UNIT_WEIGHT_NPM3 * square * passive + cohesive
        heaped = 0.5 * UNIT_WEIGHT_NPM3 * (square + heap) * passive + cohesive
        for i in range(ELEMENTS):
            x = 0.5 * length - (i + 0.5) * step
            age = abs(front - x) / creep
            across = -(twist[1] + twist[2] * x)
            slid_x, slid_y = along * age, -(twist[1] + twist[2] * 0.5 * (x + front)) * age
            pressure = load_n / tracks.area_m2 * (1.0 + 12.0 * ahead_m * x / (length * length))
            stress = tracks.cohesion_pa + pressure * tracks.tan_friction
            stress *= -math.expm1(-math.hypot(slid_x, slid_y) / tracks.shear_modulus_m)
            slides = math.sqrt(along * along + across * across + SLIDING_MPS**2)
            per_speed = stress * tracks.width_m * step / slides
            force_x, force_y = per_speed * along, per_speed * across
            if flank > 0.0:
                pushed = heaped if across * y < 0.0 else flank  # the inner track's side that faces the turn
                share = -math.expm1(-abs(slid_y) / MOBILISED_M)
                force_y += pushed * share * step * across / math.sqrt(across * across + SLIDING_MPS**2)
            out[0] += force_x
            out[1] += force_y
            out[2] += x * force_y - y * force_x
        moving, resists = twist[0] - twist[2] * y, tracks.rolling_ratio * load_n
        if depth > 0.0:
            modulus_b = tracks.kc_npmn1 + tracks.width_m * tracks.kphi_npmn2
            resists += compaction_resistance(depth, modulus_b, tracks.exponent_ratio)
        resists *= moving / math.sqrt(moving * moving + ROLLING_MPS**2)
        out[0] -= resists
        out[2] += y * resists


@njit
def inner_share(twist: Array, y: float) -> float:
    """Return how far the track at y is the inner one of a turn, from 0 to 1; half of it in turning in place.

    Examples
    --------
    >>> inner_share(np.array([0.1, 0.0, 0.0]), 0.2), inner_share(np.array([0.0, 0.0, 0.5]), 0.2)
    (0.5, 0.5)
    >>> round(inner_share(np.array([1.0, 0.0, 0.5]), 0.2), 3)  # to the left
    0.955
    """
    turning = abs(twist[2] * y)
    if turning == 0.0:
        return 0.5
    side = twist[0] * twist[2] * y
    tight = abs(twist[0]) / (abs(twist[0]) + turning)
    return 0.5 * (1.0 + math.copysign(tight, side))


@njit
def slipped_twist(
    tracks: Any, left_mps: float, right_mps: float, grade_rad: float, roll_rad: float
) -> tuple[float, float, float]:
    """Return V_x, V_y and w of belts that turn at speeds, with prescribed slip.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> tracks = tracks_on(load_robot("patako"), PrescribedSlip(0.9, 0.9))
    >>> slipped_twist(tracks[0], 1.0, 1.0, 0.0, 0.0)
    (0.9, -0.0, 0.0)
    """
    ahead = left_mps + right_mps
    along = grade_rad * (1.0 if ahead > 0.0 else -1.0 if ahead < 0.0 else 0.0)
    straight = 1.0 - tracks.slip_ratio - tracks.grade_slip_ratio * along
    left, right = tracks.eta_left_ratio * straight * left_mps, tracks.eta_right_ratio * straight * right_mps
    lost, power = tracks.turning_loss_ratio * (right - left), tracks.turning_exponent
    if power <= 1.0:
        a, b = math.pow(abs(right), 1.0 - power), math.pow(abs(left), 1.0 - power)
    else:
        a, b = math.pow(abs(left), power - 1.0), math.pow(abs(right), power - 1.0)
    share = a / (a + b) if a + b > 0.0 else 0.5
    left, right = left + lost * (1.0 - share), right - lost * share
    v_x = 0.5 * (left + right)
    return v_x, -abs(v_x) * tracks.side_slip_ratio * roll_rad, (right - left) / (2.0 * tracks.half_m)


@njit
def twist_on_soil(
    tracks: Any, state: Any, belt_mps: Array, grade_rad: float, roll_rad: float, dt_s: float
) -> Array:
    """Return the twist (3,) after a step on a soil, of records of :data:`TRACKS`, and of :data:`STATE` before it."""
    before = np.array([state.speed_x_mps, state.speed_y_mps, state.yaw_rate_radps])
    twist, residual = before.copy(), np.empty(3)
    tilt_and_heap = grade_rad, roll_rad, state.heap_m2
    error = _residual(tracks, belt_mps, twist, before, tilt_and_heap, dt_s, residual)
    jacobian, tried, changed = np.empty((3, 3)), np.empty(3), np.empty(3)
    for _ in range(ITERATIONS):
        if error < TOLERANCE:
            break
        for j in range(3):
            tried[:] = twist
            tried[j] += NUDGE
            _residual(tracks, belt_mps, tried, before, tilt_and_heap, dt_s, changed)
            for i in range(3):
                jacobian[i, j] = (changed[i] - residual[i]) / NUDGE
        newton = np.linalg.solve(jacobian, residual)
        part, lower, improved = 1.0, error, False
        for _ in range(HALVINGS):
            for i in range(3):
                tried[i] = twist[i] - part * newton[i]
            lower = _residual(tracks, belt_mps, tried, before, tilt_and_heap, dt_s, changed)
            if lower < error:
                improved = True
                break
            part *= 0.5
        if not improved:
            break
        twist[:], residual[:], error = tried, changed, lower
    return twist


@njit
def _residual(
    tracks: Any,
    belt_mps: Array,
    twist: Array,
    before: Array,
    tilt_and_heap: tuple[float, float, float],
    dt_s: float,
    out: Array,
) -> float:
    """Write what is missing to the balance, over the mass, and return its size in m/s^2."""
    track_forces(tracks, belt_mps, twist, *tilt_and_heap, out)
    turning = (-twist[2] * twist[1], twist[2] * twist[0], 0.0)
    mass = (tracks.mass_kg, tracks.mass_kg, tracks.inertia_kgm2)
    size = (tracks.mass_kg, tracks.mass_kg, tracks.mass_kg * tracks.half_m)
    total = 0.0
    for i in range(3):
        out[i] = (mass[i] * ((twist[i] - before[i]) / dt_s + turning[i]) - out[i]) / size[i]
        total += out[i] * out[i]
    return math.sqrt(total)


@inner
def step(tracks: Any, slope: Array, state: Any, belt_mps: Array, after: Any, dt_s: float) -> None:
    """Write the state a step later."""
    grade, roll = tilt_at(slope[0], slope[1], state.yaw_rad)
    after.heap_m2 = state.heap_m2
    if tracks.sheared:
        twist = twist_on_soil(tracks, state, belt_mps, grade, roll, dt_s)
        after.speed_x_mps, after.speed_y_mps, after.yaw_rate_radps = twist
        load = min(track_loads(tracks, grade, roll)[:2])
        swept = rut_depth(tracks, load) * abs(after.yaw_rate_radps) * tracks.length_m / 4.0
        left_behind = abs(after.speed_x_mps) / tracks.length_m
        after.heap_m2 = (state.heap_m2 + dt_s * swept) / (1.0 + dt_s * left_behind)
    else:
        after.speed_x_mps, after.speed_y_mps, after.yaw_rate_radps = slipped_twist(
            tracks, belt_mps[0], belt_mps[1], grade, roll
        )
    turned = 0.5 * dt_s * (state.yaw_rate_radps + after.yaw_rate_radps)
    middle = state.yaw_rad + 0.5 * turned
    x, y = 0.5 * (state.speed_x_mps + after.speed_x_mps), 0.5 * (state.speed_y_mps + after.speed_y_mps)
    after.position_x_m = state.position_x_m + dt_s * (x * math.cos(middle) - y * math.sin(middle))
    after.position_y_m = state.position_y_m + dt_s * (x * math.sin(middle) + y * math.cos(middle))
    after.yaw_rad = state.yaw_rad + turned
    after.travelled_m = state.travelled_m + dt_s * math.hypot(x, y)


@njit
def drive_tracks(tracks: Array, slope: Array, belt_mps: Array, states: Array, dt_s: float) -> None:
    """Write all states (n,) of a drive but the first, which is its start, on one ground after the other."""
    for k in range(1, belt_mps.shape[0]):
        which = 0
        while which < tracks.size - 1 and states[k - 1].travelled_m >= tracks[which].until_m:
            which += 1
        step(tracks[which], slope, states[k - 1], belt_mps[k], states[k], dt_s)


class TrackedSensors(NamedTuple):
    """Rates and noise of a tracked robot's sensors: standard deviations of white noise, all assumed but one."""

    encoder_mps: float = 0.001  # of each speed
    gyro_radps: float = 0.003  # of each sample, and of the bias from run to run
    gyro_bias_radps: float = 0.0005
    accel_mps2: float = 0.05  # of the IMU; its heading is the integral of its gyro
    tilt_rad: float = 0.002
    yaw_rad: float = 0.001
    gnss_hz: float = RAW_HZ  # raw satellite fixes; 2 cm and 10 Hz, Deremetz et al., section VI
    gnss_m: float = sensing.RAW_STD_M
    compass_rad: float = sensing.COMPASS_STD_RAD  # of the heading beside each fix
    pose_hz: float = 100.0  # cameras around the field
    pose_m: float = 0.001
    pose_rad: float = 0.002
    belt_lag_s: float = 0.1  # of the belts behind their commands


NOISY = TrackedSensors()

# Sensors without noise, and belts without a lag.
QUIET = TrackedSensors(**{name: 0.0 for name in TrackedSensors._fields if not name.endswith("_hz")})


def run_tracked(
    robot: Robot,
    drive: Scenario | Array,
    ground: TrackedGround,
    seed: int | np.random.SeedSequence,
    *,
    conditions: Conditions,
    effects: Mapping[str, float],
    slope: Slope | None = None,
    yaw_rad: float = 0.0,
    sensors: TrackedSensors = NOISY,
) -> tuple[dict[str, Stream], tuple[Label, ...]]:
    """Return streams and labels of a drive, for :func:`terrain.simulation.run.simulate`, which describes the rest.

    Parameters
    ----------
    drive : a scenario, or commanded speeds (n, 2) of the left and the right track at 50 Hz, from rest
    ground : one for the whole run, or stretches of several
    conditions : load, and the gradient of an even slope where no ``slope`` is given; there are no undulations
    yaw_rad : heading at the start, in the plane of the slope
    sensors : rates and noise; :data:`QUIET` has none
    """
    tracked = as_drive(TrackedRobot, robot, "robot {name}: drive {drive!r} has no tracks for this ground")
    if effects:
        raise ConfigError(
            f"robot {robot.name}: on tracks that shear, no effects are simulated: leave them out"
        )
    tracked = replace(tracked, mass_kg=robot.mass_kg + conditions.payload_kg)
    if slope is None:
        ahead, left = conditions.grade_ratio
        slope = Slope(math.atan(math.hypot(ahead, left)), math.atan2(left, ahead))
    if isinstance(drive, Scenario):
        drive = wheel_motion(tracked, drive.twist, 1.0 / RATE_HZ).wheel_speed_mps
    commands = np.asarray(drive, dtype=float)
    if commands.ndim != 2 or commands.shape[1] != 2 or len(commands) < 2 or not np.isfinite(commands).all():
        raise ConfigError(
            f"track_speed_mps has shape {commands.shape}, (n, 2) finite numbers with two rows are required"
        )
    stretches = [Stretch(ground)] if isinstance(ground, Soil | PrescribedSlip) else list(ground)
    if not stretches:
        raise ConfigError("ground: no stretch is given, one at least is required")
    every, lag_s = round(1.0 / (RATE_HZ * STEP_S)), sensors.belt_lag_s
    belts = np.repeat(commands, every, axis=0)[: (len(commands) - 1) * every + 1]
    if lag_s > 0.0:
        keep = math.exp(-STEP_S / lag_s)
        belts = np.vstack([np.zeros((1, 2)), lfilter([1.0 - keep], [1.0, -keep], belts[1:], axis=0)])
    ends_m = np.cumsum([length_m for _, length_m in stretches])
    tracks = [tracks_on(tracked, part.ground, end_m) for part, end_m in zip(stretches, ends_m, strict=True)]
    states = np.zeros(len(belts), STATE)
    states["yaw_rad"][0] = yaw_rad
    drive_tracks(np.concatenate(tracks), np.array(slope), belts, states, STEP_S)
    n, turn, yaw = len(states), states["yaw_rate_radps"], states["yaw_rad"]
    v_x, v_y, body = states["speed_x_mps"], states["speed_y_mps"], np.zeros(len(states), BODY)
    for name in set(BODY.names or ()) & set(STATE.names or ()):
        body[name] = states[name]
    grade, body["roll_rad"] = np.array([tilt_at(*slope, at) for at in yaw]).T
    body["pitch_rad"] = -grade
    body["accel_x_mps2"] = np.gradient(v_x, STEP_S) - turn * v_y
    body["accel_y_mps2"] = np.gradient(v_y, STEP_S) + turn * v_x

    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    words = [int(word) for word in root.generate_state(4)]
    rngs = sensing.generators(np.random.SeedSequence(words), ("bias", "wheels", "imu", "pose", "gnss"))
    bias_radps = sensors.gyro_bias_radps * rngs["bias"].standard_normal()
    wheels = belts[::every] + sensors.encoder_mps * rngs["wheels"].standard_normal((len(commands), 2))
    steps = {}
    for name, rate_hz in (("pose", sensors.pose_hz), ("gnss", sensors.gnss_hz)):
        if not 0.0 < rate_hz <= 1.0 / STEP_S:
            raise ConfigError(
                f"a sensor's rate is {rate_hz:g} Hz, above 0 and up to {1.0 / STEP_S:g} is required"
            )
        steps[name] = np.arange(0, n, round(1.0 / (rate_hz * STEP_S)))
    std = np.array([sensors.pose_m, sensors.pose_m, sensors.pose_rad])
    poses = np.column_stack([body[name][steps["pose"]] for name in POSE_CHANNELS])
    poses += std * rngs["pose"].standard_normal(poses.shape)
    poses[:, 2] = wrapped(poses[:, 2])
    # on an even slope the body turns about its z axis alone; the heading is the integral of the gyro
    time_s, clock_s = np.arange(n) * STEP_S, np.arange(len(commands)) / RATE_HZ
    sizes = [(sensors.gyro_radps, 3), (sensors.accel_mps2, 3), (sensors.tilt_rad, 2), (sensors.yaw_rad, 1)]
    noise = np.hstack([std * rngs["imu"].standard_normal((n, k)) for std, k in sizes])
    drifted = yaw - yaw[0] + bias_radps * STEP_S * np.arange(n)
    true = sensing.tilted_imu(
        np.column_stack([np.zeros((n, 2)), turn + bias_radps]),
        np.column_stack([body["accel_x_mps2"], body["accel_y_mps2"]]),
        np.column_stack([body["roll_rad"], body["pitch_rad"], drifted]),
    )
    # slip of each track is by its own middle
    along = v_x[:, None] - turn[:, None] * robot.wheel_positions_m[:, 1]
    of_wheels = {
        "wheel_radps": belts / robot.wheel_radius_m,
        "slip_ratio": slip_ratio(belts, along, min_speed_mps=0.005),
    }
    more = {
        "yaw_rad": wrapped(yaw),
        "slip_body_rad": slip_angle(v_x, v_y, min_speed_mps=0.005),
        sensing.GYRO_BIAS: np.full(n, bias_radps),
        "heap_m2": states["heap_m2"],
    }
    at = steps["gnss"]
    streams = {
        "wheels": Stream(clock_s, wheels, robot.rate_channels),
        "imu": Stream(time_s, sensing.imu_values(true, 1.0, 0.0, noise), IMU_CHANNELS),
        "pose": Stream(steps["pose"] * STEP_S, poses, POSE_CHANNELS),
        **sensing.raw_fixes(at * STEP_S, body[at], rngs["gnss"], sensors.gnss_m, sensors.compass_rad),
        "commands": Stream(clock_s, commands, robot.rate_channels),
        "truth": sensing.truth_stream(time_s, body, robot.wheels, of_wheels, more),
    }
    # labels are the soils by time; slip that is prescribed has no name
    which = np.minimum(np.searchsorted(ends_m, states["travelled_m"], side="right"), len(stretches) - 1)
    labels = []
    for k, part in enumerate(stretches):
        inside = np.flatnonzero(which == k)
        if inside.size > 1 and isinstance(part.ground, Soil):
            labels.append(Label(float(inside[0] * STEP_S), float(inside[-1] * STEP_S), part.ground.name))
    return streams, tuple(labels)
