r"""Slip of a tracked robot on a weak slope: the four laws of Yamauchi et al. as one that is continuous.

Speeds v of the tracks, the mean :math:`\bar v` of their magnitudes, yaw rate w, half track d, grade
:math:`= -pitch`; b are errors that a whole run has in common, with a mean of 0:

.. math::
    v_i' &= v_i (1 - \alpha_0) - |v_i|\, \alpha_1\, grade, \qquad D = v_r' - v_l' - 2 d w \\
    V_x &= \frac{v_r' + v_l'}{2} - \frac{D}{2} \kappa(n) - \lambda_x |w|\, grade - \bar v\, b_\alpha \\
    V_y &= |V_x| \tan \beta - \lambda_y |w|\, roll + c\, w\, grade + \bar v\, b_\beta \\
    \beta &= -(1 - \eta) \arctan(k\, roll) + \eta\, m \sum_i a_i X_i \\
    \eta &= 3 q^2 - 2 q^3, \quad q = \min(\theta / \theta_1, 1), \quad
    \theta = |v_r - v_l| / (|v_r| + |v_l|)

- *Longitudinal, straight*: (22), a slip ratio linear in the grade, with the compaction as its intercept.  It
  needs no switch: each track has to overcome them in a turn as well.
- *Longitudinal, turning*: Endo's law (:func:`slip_imbalance`) shares what slip is left.  D and kappa both vanish with
  the turn, so that its part falls with the square of it.
- *Drift in a turn*, this project's: the ground's friction is spent on turning, so that gravity moves the
  robot downhill at a speed in proportion to the yaw rate, by :math:`\lambda_x, \lambda_y`.  On a grade the
  load moves to the rear, and the robot turns about a point that lies :math:`c\, grade` behind its middle.
  All three are 0 for the laws as printed; with them little is left for (28).
- *Lateral, straight*: (26).  **Corrected**: gravity sets the sign, also in reverse, by the absolute value of
  V_x.
- *Lateral, turning*: the regression (28), weighted by how tight the turn is.  The weight eta is smooth and
  has no memory: it is 0 in straight motion and 1 where the tightness theta (:math:`d |w| / |\bar v|` without
  slip, 1 where the tracks run against each other) is at least theta_1.

So the velocity is continuous in all that is measured.  The regressors X are those of (28) as seen in a left
turn driven forward: a right turn is its mirror image (m = -1), and so is a reversed one, end to end; the
coefficients of one turn hold for all four.  Towards a spin in place, which has no forward end, what differs
between the two ends fades out.  The yaw displacement since the turn began is forgotten over a length of the
track travelled straight, which leaves behind the soil that the turn heaped up.

As printed, a slip angle cannot express that a robot spinning in place drifts across a slope: V_y vanishes
with V_x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from terrain.errors import ConfigError
from terrain.files.atomic import atomic_write
from terrain.files.documents import check_keys, read_yaml
from terrain.files.names import shown
from terrain.kernels import njit
from terrain.records import Array, read_only

REGRESSORS: tuple[str, ...] = (
    *("intercept", "input_speed_mps", "input_yaw_rate_radps", "gyro_yaw_rate_radps"),
    *("roll_rad", "pitch_rad", "yaw_displacement_rad", "slope_rad"),
)
"""Explanatory variables X of (28), in its order."""

N_ANGLE = len(REGRESSORS)
EXPONENT, COMPACTION, GRADE, TURN_GRADE, SIDE, TURN_SIDE, TURN_SHIFT, ANGLE = range(8)
TRACK_RATIO = ANGLE + N_ANGLE
N_MODEL = TRACK_RATIO + 1
RUN_SLIP, RUN_ANGLE, GYRO_BIAS = N_MODEL, N_MODEL + 1, N_MODEL + 2
N_PARAMETERS = N_MODEL + 3

PARAMETERS: tuple[str, ...] = (
    *("turning_exponent", "compaction_slip_ratio", "grade_slip_ratio", "turn_grade_m"),
    *("side_slip_ratio", "turn_side_m", "turn_shift_m"),
    *(f"angle_{name}" for name in REGRESSORS),
    "track_ratio",
)
"""Names of the numbers of a model, in the order of its covariance."""

TIGHT_RATIO = 0.5
"""theta_1: an arc around a centre one track away from the middle of the robot."""

SPIN_RATIO = 0.3
"""Sum of the speeds of the tracks over that of their magnitudes below which a turn is a spin, in part."""

STEEPEST_RAD = 1.2
"""Slip angles beyond, by coefficients that do not fit, are held at this: tan is 2.6 there."""


@dataclass(frozen=True, eq=False)
class SlipModel:
    """Numbers of the slip laws of one robot on one ground; without arguments there is no slip.

    Raises
    ------
    ConfigError
        if a number is not finite, or the shape of an array is another.

    Examples
    --------
    >>> SlipModel(turning_exponent=0.85).vector[:2]
    array([0.85, 0.  ])
    """

    turning_exponent: float = 1.0  #: n of (27)
    compaction_slip_ratio: float = 0.0  #: intercept and slope (per rad) of (22)
    grade_slip_ratio: float = 0.0
    turn_grade_m: float = 0.0  #: lambda_x, speed back down by yaw rate and grade
    side_slip_ratio: float = 0.0  #: k of (26), per rad
    #: (8,) coefficients of (28) in rad, for SI units, in the order of :data:`REGRESSORS`
    angle: Array = field(default_factory=lambda: np.zeros(N_ANGLE))
    #: effective distance of the tracks over the described one, for a robot without a gyro
    track_ratio: float = 1.0
    #: (16, 16) of :data:`PARAMETERS`
    covariance: Array = field(default_factory=lambda: np.zeros((N_MODEL, N_MODEL)))
    slip_std_ratio: float = 0.0  #: residuals of V_x and V_y within a run, over the speed of the tracks
    angle_std_rad: float = 0.0
    run_slip_std_ratio: float = 0.0  #: b, what a whole run has in common
    run_angle_std_rad: float = 0.0
    found: str = "given"  #: how the numbers were found
    correlation_s: float = 0.5  #: over which the residuals within a run are alike
    turn_side_m: float = 0.0  #: lambda_y, speed down to the side by yaw rate and roll
    turn_shift_m: float = 0.0  #: c, distance behind the middle of the point of turning, per rad of grade

    def __post_init__(self) -> None:
        for name, shape in (("angle", (N_ANGLE,)), ("covariance", (N_MODEL, N_MODEL))):
            value = read_only(np.array(getattr(self, name), dtype=float))
            if value.shape != shape:
                raise ConfigError(f"slip model: {name} has the shape {value.shape}, {shape} is required")
            object.__setattr__(self, name, value)
        stds = (self.slip_std_ratio, self.angle_std_rad, self.run_slip_std_ratio, self.run_angle_std_rad)
        if not (np.isfinite(self.vector).all() and np.isfinite(self.covariance).all()):
            raise ConfigError("slip model: all numbers have to be finite")
        if self.turning_exponent < 0 or self.track_ratio <= 0 or not all(0 <= std < np.inf for std in stds):
            raise ConfigError(
                "slip model: turning_exponent and standard deviations from zero up, track_ratio above zero "
                "are required"
            )

    @property
    def vector(self) -> Array:
        """Numbers (16,) in the order of :data:`PARAMETERS`."""
        first = [getattr(self, name) for name in PARAMETERS[:ANGLE]]
        return np.array([*first, *self.angle, self.track_ratio])


def model_of(vector: Array, **also: Any) -> SlipModel:
    """Return the model of numbers (16,) in the order of :data:`PARAMETERS`; ``also`` are other fields.

    Examples
    --------
    >>> model_of(SlipModel(turning_exponent=0.7).vector).turning_exponent
    0.7
    """
    first = dict(zip(PARAMETERS[:ANGLE], vector[:ANGLE].tolist(), strict=True))
    angle, ratio = vector[ANGLE:TRACK_RATIO], float(vector[TRACK_RATIO])
    return SlipModel(**first, angle=angle, track_ratio=ratio, **also)


PRIOR_STD = np.array([0.3, 0.1, 1.0, 0.3, 1.0, 0.3, 0.2, 0.3, 3.0, 1.0, 1.0, 2.0, 1.0, 0.5, 2.0, 0.5])
"""Of :data:`PARAMETERS` on unknown ground, wide around the values printed by Yamauchi et al. (converted from
degrees) and those of sand."""


def unknown_ground() -> SlipModel:
    """Return what is assumed of a ground that was never driven on: wide in every number.

    Examples
    --------
    >>> unknown_ground().turning_exponent
    0.85
    """
    return SlipModel(
        turning_exponent=0.85,
        track_ratio=1.5,
        covariance=np.diag(PRIOR_STD**2),
        slip_std_ratio=0.03,
        angle_std_rad=0.05,
        found="unknown ground",
    )


@njit
def slip_imbalance(speed_left_mps: float, speed_right_mps: float, exponent: float) -> float:
    r"""Return kappa of Endo's law (27), the right track's part of the slip of a turn less the left one's.

    With the slip speeds :math:`u = v \alpha` (what a track moves faster than the ground under it), (7) and (27) are
    :math:`u_r - u_l = D` and :math:`\alpha_l / \alpha_r = -\mathrm{sgn}(v_r v_l) |v_r / v_l|^n`.  **Corrected**: (27)
    is singular where a track stops.  Written in slip speeds the signs cancel, and

    .. math::
        u_r = D \frac{a}{a + b}, \quad u_l = -D \frac{b}{a + b}, \qquad
        a = |v_r|^{1 - n},\; b = |v_l|^{1 - n} \;(n \le 1), \quad
        a = |v_l|^{n - 1},\; b = |v_r|^{n - 1} \;(n > 1),

    regular for all speeds that are not both 0.  The speed of the body needs only

    .. math:: \kappa = \frac{a - b}{a + b} = \tanh\left(\frac{1 - n}{2} \ln \left|\frac{v_r}{v_l}\right|\right),

    one expression for all n, within [-1, 1]: 1 where the left track stands and n < 1, so that the right one takes all
    of the slip; 0 for n = 1 and for equal speeds, stopped tracks included.

    Examples
    --------
    >>> slip_imbalance(0.0, 0.1, 0.85), slip_imbalance(0.1, 0.0, 0.85), round(slip_imbalance(0.05, 0.1, 0.85), 4)
    (1.0, -1.0, 0.0519)
    """
    left, right = abs(speed_left_mps), abs(speed_right_mps)
    if left == right or exponent == 1.0:
        return 0.0
    if left == 0.0 or right == 0.0:
        return math.copysign(1.0, (1.0 - exponent) * (right - left))
    return math.tanh(0.5 * (1.0 - exponent) * (math.log(right) - math.log(left)))


@njit
def turn_weight(speed_left_mps: float, speed_right_mps: float) -> float:
    """Return eta, 0 in straight motion and 1 in a tight turn; 0 where both tracks stand.

    Examples
    --------
    >>> turn_weight(0.1, 0.1), turn_weight(0.07, 0.12), turn_weight(-0.01, 0.12)
    (0.0, 0.5394..., 1.0)
    """
    total = abs(speed_left_mps) + abs(speed_right_mps)
    if total == 0.0:
        return 0.0
    q = min(abs(speed_right_mps - speed_left_mps) / total / TIGHT_RATIO, 1.0)
    return q * q * (3.0 - 2.0 * q)


@njit
def next_displacement(
    displacement_rad: float,
    speeds_mps: tuple[float, float],
    yaw_rate_radps: float,
    length_m: float,
    dt_s: float,
) -> float:
    """Return the yaw displacement since the turn began, a step later.

    It is forgotten over the length of the track travelled straight.
    """
    straight = 1.0 - turn_weight(speeds_mps[0], speeds_mps[1])
    travelled = 0.5 * abs(speeds_mps[0] + speeds_mps[1]) * dt_s
    return (displacement_rad + yaw_rate_radps * dt_s) * math.exp(-straight * travelled / length_m)


@njit
def angle_regressors(
    speeds_mps: tuple[float, float],
    yaw_rate_radps: float,
    roll_rad: float,
    pitch_rad: float,
    displacement_rad: float,
    half_track_m: float,
    out: Array,
) -> None:
    """Write m times the regressors X (8,) of (28); the first is m, 1 in a left turn driven forward."""
    left, right = speeds_mps
    total = max(abs(left) + abs(right), 1e-300)
    forward = min(max((left + right) / total / SPIN_RATIO, -1.0), 1.0)
    turn = 1.0 if right >= left else -1.0
    out[0], out[1] = turn * forward, turn * forward * 0.5 * abs(left + right)
    out[2] = forward * (right - left) / (2.0 * half_track_m)
    out[3] = forward * yaw_rate_radps
    out[4], out[5] = roll_rad, turn * pitch_rad
    out[6] = forward * displacement_rad
    slope = math.acos(min(max(math.cos(roll_rad) * math.cos(pitch_rad), -1.0), 1.0))
    out[7] = turn * forward * slope


@njit
def body_velocity(
    theta: Array,
    half_track_m: float,
    speeds_mps: tuple[float, float],
    yaw_rate_radps: float,
    tilt_rad: tuple[float, float],
    displacement_rad: float,
) -> tuple[float, float]:
    """Return V_x and V_y.

    Parameters
    ----------
    theta : (N_PARAMETERS,) numbers of the model and errors of the run
    half_track_m : d
    speeds_mps : left, right
    yaw_rate_radps : w, without the gyro's bias
    tilt_rad : roll, pitch
    displacement_rad : yaw since the turn began
    """
    left, right = speeds_mps
    roll, grade, turning = tilt_rad[0], -tilt_rad[1], abs(yaw_rate_radps)
    kappa = slip_imbalance(left, right, theta[EXPONENT])
    rolling, climbed = 1.0 - theta[COMPACTION], theta[GRADE] * grade
    mean, half = 0.5 * (left + right), 0.5 * (right - left)
    mean_size, half_size = 0.5 * (abs(left) + abs(right)), 0.5 * (abs(right) - abs(left))
    lost = rolling * half - climbed * half_size - half_track_m * yaw_rate_radps
    v_x = rolling * mean - climbed * mean_size - lost * kappa
    v_x -= turning * theta[TURN_GRADE] * grade + mean_size * theta[RUN_SLIP]
    regressors = np.empty(N_ANGLE)
    angle_regressors(
        speeds_mps, yaw_rate_radps, roll, tilt_rad[1], displacement_rad, half_track_m, regressors
    )
    tight = turn_weight(left, right)
    beta = -(1.0 - tight) * math.atan(theta[SIDE] * roll)
    for i in range(N_ANGLE):
        beta += tight * regressors[i] * theta[ANGLE + i]
    v_y = abs(v_x) * math.tan(min(max(beta, -STEEPEST_RAD), STEEPEST_RAD))
    v_y += theta[TURN_SHIFT] * yaw_rate_radps * grade - theta[TURN_SIDE] * turning * roll
    return v_x, v_y + mean_size * theta[RUN_ANGLE]


RESIDUALS = ("slip_std_ratio", "angle_std_rad", "run_slip_std_ratio", "run_angle_std_rad", "correlation_s")
"""Residuals of a model, and the time over which they are alike."""

DIGITS, ROUNDED = 6, 1e-4
"""Of the numbers written, and what their rounding makes of correlations."""


def write_slip_model(path: Path, model: SlipModel, robot: str) -> None:
    """Write the slip model of a robot; as :func:`check_slip_model_file`.

    Each parameter has its value and its standard deviation; correlations are left out unless they are given::

        robot: patako
        found: 12 runs with poses, 3400 samples
        parameters:
          turning_exponent: {value: 0.86, std: 0.004}
          ...
        residuals:
          slip_std_ratio: 0.01
          ...
        correlation:
        - [1.0, 0.1, ...]
    """
    check_slip_model_file(path)

    def rounded(value: float) -> float:
        return float(f"{value:.{DIGITS}g}")

    std = np.sqrt(np.diag(model.covariance))
    scale = np.where(std > 0.0, std, 1.0)
    correlation = model.covariance / np.outer(scale, scale)
    np.fill_diagonal(correlation, 1.0)
    pairs = zip(PARAMETERS, model.vector, std, strict=True)
    content = {
        "robot": robot,
        "found": model.found,
        "parameters": {
            name: {"value": rounded(value), "std": rounded(error)} for name, value, error in pairs
        },
        "residuals": {name: rounded(getattr(model, name)) for name in RESIDUALS},
        "correlation": [[rounded(each) for each in row] for row in correlation],
    }
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=math.inf)
    title = (
        "# Slip of a tracked robot on one ground, for terrain estimate --filter slip-odometry --slip-model."
    )
    atomic_write(path, f"{title}\n{text}")


def check_slip_model_file(path: Path) -> None:
    """Refuse, by ``ConfigError``, the place of a new slip model that is no YAML file, or is there already."""
    if path.suffix not in (".yaml", ".yml"):
        raise ConfigError(f"{path}: a slip model is a .yaml file")
    if path.exists():
        raise ConfigError(f"{path}: is there already, and is left as it is; choose another name")


def read_slip_model(path: Path, robot: str) -> SlipModel:
    """Return the slip model of a file.

    Raises
    ------
    ConfigError
        if it cannot be read, lacks a parameter, has an unknown one or no number, or is of another robot.
    """

    def finite(place: str, value: Any, least: float = -math.inf) -> float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        if not is_number or value < least:
            kind = "a finite number from zero up" if least == 0.0 else "a finite number"
            raise ConfigError(f"{path.name}: {place} is {shown(value)}, {kind} is required")
        return float(value)

    described = read_yaml(path)
    check_keys(path.name, described, ["robot", "found", "parameters", "residuals"], optional=("correlation",))
    if described["robot"] != robot:
        raise ConfigError(
            f"{path.name}: is the slip model of robot {shown(described['robot'])}, not {robot!r}"
        )
    known, n = described["parameters"], len(PARAMETERS)
    check_keys(f"{path.name}: parameters", known, list(PARAMETERS))
    check_keys(f"{path.name}: residuals", described["residuals"], list(RESIDUALS))
    for name in PARAMETERS:
        check_keys(f"{path.name}: parameters: {name}", known[name], ["value", "std"])
    values = np.array([finite(f"parameters: {name}: value", known[name]["value"]) for name in PARAMETERS])
    stds = np.array([finite(f"parameters: {name}: std", known[name]["std"], 0.0) for name in PARAMETERS])
    residuals = {name: finite(f"residuals: {name}", described["residuals"][name], 0.0) for name in RESIDUALS}
    rows, correlation = described.get("correlation"), np.eye(n)
    if rows is not None:
        if (
            not isinstance(rows, list)
            or [len(row) if isinstance(row, list) else 0 for row in rows] != [n] * n
        ):
            raise ConfigError(f"{path.name}: correlation: {n} rows of {n} numbers are required")
        correlation = np.array([[finite("correlation", each) for each in row] for row in rows])
        is_one = np.abs(np.diag(correlation) - 1.0).max() <= ROUNDED
        is_symmetric = np.allclose(correlation, correlation.T, atol=ROUNDED)
        if not (is_one and is_symmetric) or np.linalg.eigvalsh(correlation)[0] < -ROUNDED:
            raise ConfigError(
                f"{path.name}: correlation: these are no correlations: 1 on the diagonal, symmetric, none beyond 1"
            )
    covariance = correlation * np.outer(stds, stds)
    return model_of(values, covariance=covariance, found=str(described["found"]), **residuals)
