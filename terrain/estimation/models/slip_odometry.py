r"""Odometry of a tracked robot by a slip model, which fixes correct: one filter, of which five odometries are settings.

State: the pose :math:`x, y, \theta`, which moves by (5) to (7) of Yamauchi et al. (ROBOMECH Journal 2017),

.. math:: x' = V_x \cos\theta - V_y \sin\theta, \quad y' = V_x \sin\theta + V_y \cos\theta, \quad \theta' = w,

with the velocity that :mod:`~terrain.estimation.models.slip_model` makes of the speeds of the tracks, the gyro and
the tilt, along arcs; all parameters of that model, the errors of the run and the bias of the gyro, which do not change
within a run; and the residuals of V_x and V_y, which do, over their correlation time.  So an error that a whole run has
in common grows with the distance, and noise with its root.

====================  ============================  ====================================================
odometry              slip model                    yaw rate
====================  ============================  ====================================================
``encoder-odometry``  none                          of the tracks, over their effective distance
``gyrodometry``       none                          of the gyro where the two differ by a threshold, which in
                                                    a slipping turn is always (Borenstein and Feng 1996)
``endo``              longitudinal slip of turns    of the gyro (Endo et al. 2007)
``slip-odometry``     identified before             of the gyro
``slip-learning``     identified while driving      of the gyro
====================  ============================  ====================================================

The first three know nothing of the slip that they lack: their standard deviations hold the errors assumed in
:data:`UNKNOWN_SLIP_RATIO` and :data:`UNKNOWN_ANGLE_RAD`, one of each a run.  Without a gyro the tracks stand in.

**Learning** (future work of Yamauchi et al.).  The covariance is that of the pose *and* of the parameters, so that a
fix of the position measures both; fixes may be sparse, and a loop closure is a fix as well.  What is observable:

- encoders and gyro alone give :math:`D = v_r - v_l - 2 d w`, hence the effective distance of the tracks and,
  *with n assumed*, the slip of each track; they give neither n nor any slip that both tracks share;
- positions give the straight slip while driving straight on grades, the side slip on side slopes, and n and
  the regression (28) in turns, each by what those motions excite;
- sub-tracks are no part of the model.

A parameter whose standard deviation has not fallen to half of that at the start is not observed: its mean is
NaN outside, while the filter goes on with what it has.

**Corrected** against the paper: (27) without its singular points, (26) in reverse, (22) by the grade; see there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.errors import ConfigError
from terrain.estimation.filter import FilterModel, FilterSettings, differentiate
from terrain.estimation.models.observer import (
    LONGEST_STEP_S,
    FilterObserver,
    ObserverOutput,
    ObserverStatus,
)
from terrain.estimation.models.slip_model import (
    GYRO_BIAS,
    N_MODEL,
    N_PARAMETERS,
    PARAMETERS,
    RUN_ANGLE,
    RUN_SLIP,
    TRACK_RATIO,
    SlipModel,
    body_velocity,
    model_of,
    next_displacement,
)
from terrain.kernels import njit
from terrain.records import Array
from terrain.robots import TrackedRobot

ROWS = ("speed_left_mps", "speed_right_mps", "yaw_rate_radps", "roll_rad", "pitch_rad")
FIX_ROWS = ("position_x_m", "position_y_m", "yaw_rad")
STATES = (*FIX_ROWS, "speed_x_mps", "speed_y_mps", "yaw_rate_radps")
SLIPS = ("slip_left_ratio", "slip_right_ratio", "slip_body_rad")

BLIND_MPS = 0.5
"""Of tracks whose speeds are not known: slow robots too may have begun to drive."""
LOST_M = 1e6
"""Standard deviation above which a position is not known at all; a position beyond is none in a local frame."""
FASTEST_MPS, FASTEST_RADPS = 20.0, 20.0
"""More than a track or a robot can; such a reading is wrong."""
TURNING_RADPS = 0.05
"""Slower, a yaw rate shows nothing of the distance of the tracks."""
OBSERVED_RATIO = 0.5
"""Of its standard deviation at the start: a parameter below it is observed."""
UNKNOWN_SLIP_RATIO, UNKNOWN_ANGLE_RAD = 0.1, 0.1
"""Slip that odometry without a slip model may miss; assumed, what a grade of 10 degrees does on sand."""
TRACK_STD_RATIO = 0.2
"""Of an effective distance of the tracks that was not identified on this ground; assumed."""
GYRODOMETRY_THRESHOLD_RADPS = 0.01
"""Above the drift of the gyro and the noise of the encoders, far under what slip makes in a turn."""

FILTER_SETTINGS = FilterSettings(gate_probability=0.999, reopen_after_s=1.0)
"""One fix in a thousand is left out; after a second of those that are rejected the position begins anew."""

_D = 3 + N_PARAMETERS + 2
_MODEL = slice(3, 3 + N_MODEL)
_LIMITS = (np.full(N_MODEL, -100.0), np.full(N_MODEL, 100.0))  # of the parameters while they are learned
for _place, _low, _high in ((0, 0.0, 3.0), (TRACK_RATIO, 0.3, 10.0)):
    _LIMITS[0][_place], _LIMITS[1][_place] = _low, _high
_KNOWN_STD = 1e-6  # of what is taken as known: a filter has no state without a variance


class OdometrySettings(NamedTuple):
    """Noise and limits of the odometry of a tracked robot."""

    gyro_threshold_radps: float = 0.0  #: the gyro is used where it differs from the tracks by more; 0: always
    gyro_noise_radps: float = 0.002  #: of a sample, and of what is left of the bias
    gyro_bias_std_radps: float = 0.0005
    encoder_noise_mps: float = 0.001  #: of a sample of the speed of a track
    stand_mps: float = 0.003  #: both tracks slower: the robot stands, or is pushed
    pushed_radps: float = 0.02  #: yaw rate above which a robot on standing tracks is pushed
    min_speed_mps: float = 0.005  #: tracks and ground slower: the slip of the track is NaN
    fix_std_m: float = 0.02  #: of a position along an axis, and of a heading
    yaw_fix_std_rad: float = 0.02
    ratio_std: float = 0.1  #: of the ratio of the tracks' yaw rate and the gyro's, from turn to turn


DEFAULTS, NO_SLIP = OdometrySettings(), SlipModel()

# Places in `params`: half the distance of the tracks, the correlation time, and as inputs those of a tick.
_HALF, _CORRELATION, _LEFT, _RIGHT, _GYRO, _ROLL, _PITCH, _DISPLACEMENT = range(8)
_INPUTS = ("left", "right", "gyro", "roll", "pitch", "displacement")


@njit
def velocity(x: Array, params: Array) -> tuple[float, float, float]:
    """Return V_x, V_y and w of a state; a gyro that is NaN is not used, and tracks of speed 0 stand."""
    theta = x[3 : 3 + N_PARAMETERS].copy()
    theta[RUN_SLIP] += x[_D - 2]
    theta[RUN_ANGLE] += x[_D - 1]
    left, right, gyro = params[_LEFT], params[_RIGHT], params[_GYRO]
    if math.isnan(gyro):
        rate = (right - left) / (2.0 * params[_HALF] * theta[TRACK_RATIO])
    else:
        rate = gyro - theta[GYRO_BIAS]
    if left == 0.0 and right == 0.0:
        return 0.0, 0.0, rate
    tilt = (params[_ROLL], params[_PITCH])
    v_x, v_y = body_velocity(theta, params[_HALF], (left, right), rate, tilt, params[_DISPLACEMENT])
    return v_x, v_y, rate


@njit
def _move(x: Array, dt: float, params: Array, x_next: Array) -> None:
    """Move along an arc, without error however far the body turns: a chord of sin(w dt / 2) / (w dt / 2)."""
    v_x, v_y, rate = velocity(x, params)
    half = 0.5 * rate * dt
    chord = dt * (1.0 - half * half / 6.0 if abs(half) < 1e-4 else math.sin(half) / half)
    cos, sin = chord * math.cos(x[2] + half), chord * math.sin(x[2] + half)
    x_next[:] = x
    x_next[0] += cos * v_x - sin * v_y
    x_next[1] += sin * v_x + cos * v_y
    x_next[2] += rate * dt
    left = math.exp(-dt / params[_CORRELATION])
    x_next[_D - 2], x_next[_D - 1] = left * x[_D - 2], left * x[_D - 1]


@njit
def _propagate(x: Array, dt: float, params: Array, x_next: Array, f: Array) -> None:
    differentiate(_move, x, dt, params, x_next, f)


@njit
def _observe(x: Array, params: Array, z_hat: Array, h: Array) -> None:
    for i in range(3):
        z_hat[i] = x[i]
        h[i, i] = 1.0
    z_hat[3] = x[3 + TRACK_RATIO]
    h[3, 3 + TRACK_RATIO] = 1.0


@njit
def _outputs(x: Array, _dt: float, params: Array, y: Array) -> None:
    """Write pose, V_x, V_y and w, and the parameters of the model."""
    y[:3] = x[:3]
    y[3], y[4], y[5] = velocity(x, params)
    y[6:] = x[3 : 3 + N_MODEL]


@njit
def _read(x: Array, params: Array) -> tuple[Array, Array]:
    y, by_x = np.empty(6 + N_MODEL), np.empty((6 + N_MODEL, _D))
    differentiate(_outputs, x, 0.0, params, y, by_x)
    return y, by_x


class SlipOdometry(FilterObserver):
    """An odometry of a tracked robot.

    Parameters
    ----------
    robot : its tracks
    model : slip on this ground, as ``terrain calibrate --what odometry`` finds it; of ``slip-learning`` what is known
        before
    settings : noise and limits
    name : of the table of this module; that of ``slip-learning`` takes fixes

    Raises
    ------
    ConfigError
        if it learns, and a parameter of the model has no standard deviation.

    Notes
    -----
    Statuses: ``STANDING`` and ``PUSHED`` with both tracks stopped, the pose held or turned by the gyro;
    ``PREDICTED`` without a tilt, the last one being used; ``REJECTED`` for a yaw rate that cannot be, replaced by that
    of the tracks, and for a fix; ``BAD_INPUT`` for speeds or times that cannot be, the pose being less certain by what
    may have been driven.  One that learns starts at the first fix with a heading.

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> odometry = SlipOdometry(load_robot("patako"), SlipModel(compaction_slip_ratio=0.1))
    >>> row = np.array([0.1, 0.1, 0.0, 0.0, 0.0])
    >>> for _ in range(101):
    ...     known = odometry.step(row, 0.01)
    >>> known.mean[:3].round(3), known.slip.round(2)
    (array([0.09, 0.  , 0.  ]), array([0.1, 0.1, 0. ]))
    """

    def __init__(
        self,
        robot: TrackedRobot,
        model: SlipModel,
        settings: OdometrySettings = DEFAULTS,
        name: str = "slip-odometry",
    ) -> None:
        self._learns, self._settings, self._model = name == "slip-learning", settings, model
        self._prior = prior = np.sqrt(np.diag(model.covariance))
        if self._learns and not (prior > 0.0).all():
            raise ConfigError(
                f"slip learning: {PARAMETERS[int(np.argmin(prior))]} has no standard deviation above zero"
            )
        self._half_m, self._length_m = robot.half_track_m, robot.contact_length_m
        correlation_s = max(model.correlation_s, 1e-3)
        residuals = np.array([model.slip_std_ratio, model.angle_std_rad])
        errors = (model.run_slip_std_ratio, model.run_angle_std_rad, settings.gyro_bias_std_radps)
        std = np.maximum([0.0, 0.0, 0.0, *prior, *errors, *residuals], _KNOWN_STD)
        parameters = (*PARAMETERS, "run_slip", "run_angle", "gyro_bias")
        process = np.zeros(_D)
        process[-2:] = 2.0 * residuals**2 / correlation_s
        fix_std = (settings.fix_std_m, settings.fix_std_m, settings.yaw_fix_std_rad)
        filter_model = FilterModel(
            name=name,
            states=(
                *FIX_ROWS,
                *(f"parameter_{parameter}_ratio" for parameter in parameters),
                *("residual_slip_ratio", "residual_angle_ratio"),
            ),
            rows=(*FIX_ROWS, "track_ratio"),
            sensors=(("position", FIX_ROWS[:2]), ("heading", FIX_ROWS[2:]), ("tracks", ("track_ratio",))),
            propagate=_propagate,
            observe=_observe,
            params=np.array([self._half_m, correlation_s]),
            process_variance=process,
            measurement_variance=np.square([*fix_std, settings.ratio_std]),
            initial_variance=std**2,
            initial_mean=np.array([0.0, 0.0, 0.0, *model.vector, *np.zeros(5)]),
            inputs=_INPUTS,
            positions=FIX_ROWS[:2],
            angle_rows=FIX_ROWS[2:],
        )
        super().__init__(filter_model, FILTER_SETTINGS)
        self.filter.cov[_MODEL, _MODEL] += model.covariance - np.diag(prior**2)
        self.rows = (*ROWS, *FIX_ROWS) if self._learns else ROWS
        self.states = (*STATES, *(PARAMETERS if self._learns else ()))
        self.slips = SLIPS[: {"encoder-odometry": 0, "gyrodometry": 0, "endo": 2}.get(name)]
        self._is_located, self._displacement_rad, self._tilt_rad = not self._learns, 0.0, (0.0, 0.0)
        self._fastest_mps = BLIND_MPS
        self._output = self._output_of(np.zeros(6), 0.0, ObserverStatus.STARTING)

    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row of :attr:`rows`."""
        settings, mean, cov = self._settings, self.filter.mean, self.filter.cov
        left, right, gyro, roll, pitch = row[:5].tolist()
        if not (0.0 <= dt_s <= LONGEST_STEP_S and abs(left) <= FASTEST_MPS and abs(right) <= FASTEST_MPS):
            # the pose is less certain by a motion as fast as the tracks were
            moved_m = self._fastest_mps * dt_s if 0.0 < dt_s < math.inf else 0.0
            std = np.sqrt(cov.diagonal()[:3])
            wider = std + moved_m / np.array([1.0, 1.0, self._half_m])
            std = np.maximum(np.minimum(wider, [LOST_M, LOST_M, math.pi]), std)
            cov[range(3), range(3)] = std**2
            known_std = np.concatenate([std, self._output.std[3:]])
            self._output = self._output._replace(std=known_std, status=int(ObserverStatus.BAD_INPUT))
            return self._output
        status = ObserverStatus.OK
        by_track = 2.0 * self._half_m * float(mean[3 + TRACK_RATIO])
        tracks, bias = (right - left) / by_track, float(mean[3 + GYRO_BIAS])
        if not abs(gyro) <= FASTEST_RADPS:
            status, gyro = (ObserverStatus.OK if math.isnan(gyro) else ObserverStatus.REJECTED), math.nan
        by_gyro = abs(gyro - bias - tracks) >= settings.gyro_threshold_radps
        rate, rate_variance = tracks, 2.0 * (settings.encoder_noise_mps / by_track) ** 2
        if by_gyro:
            rate, rate_variance = gyro - bias, settings.gyro_noise_radps**2
        if abs(roll) <= 0.5 * math.pi and abs(pitch) <= 0.5 * math.pi:
            self._tilt_rad = roll, pitch
        else:
            status = ObserverStatus.PREDICTED
        self._fastest_mps = max(abs(left), abs(right), BLIND_MPS)
        stands = abs(left) <= settings.stand_mps and abs(right) <= settings.stand_mps
        used = (left, right, gyro if by_gyro else math.nan)
        if stands:
            is_pushed = abs(rate) > settings.pushed_radps
            status = ObserverStatus.PUSHED if is_pushed else ObserverStatus.STANDING
            used = (0.0, 0.0, used[2] if is_pushed else math.nan)
            rate_variance = rate_variance if is_pushed else 0.0
        inputs = np.array([*used, *self._tilt_rad, self._displacement_rad])
        walk, z, variance = np.zeros(_D), np.full(4, np.nan), np.array(self.filter.model.measurement_variance)
        walk[2] = rate_variance * dt_s
        if not stands:
            along = np.array([math.cos(mean[2]), math.sin(mean[2])])
            walk[:2] = 0.5 * settings.encoder_noise_mps**2 * dt_s * along**2
        fix = np.where(np.abs(row[5:8]) <= LOST_M, row[5:8], np.nan)
        if self._learns:
            if self._is_located:
                z[:3] = fix
            by_tracks = (used[1] - used[0]) / (2.0 * self._half_m)
            if not stands and dt_s > 0.0 and abs(used[2]) > TURNING_RADPS and used[2] * by_tracks > 0.0:
                z[3] = by_tracks / used[2]
                variance[3] *= max(2.0 * self._model.correlation_s / dt_s, 1.0)
        judged = self.advance(dt_s, z, inputs, walk, variance, n_judged=2)
        if self._learns:
            mean[_MODEL] = np.clip(mean[_MODEL], *_LIMITS)
            if not self._is_located and np.isfinite(fix).all():
                self._is_located = True
                mean[:3], cov[:3, :], cov[:, :3] = fix, 0.0, 0.0
                cov[:3, :3] = np.diag(variance[:3])
        if not stands:
            self._displacement_rad = next_displacement(
                self._displacement_rad, (left, right), rate, self._length_m, dt_s
            )
        if not self._is_located:
            status = ObserverStatus.STARTING
        elif judged is not ObserverStatus.OK:
            status = judged
        self._output = self._output_of(inputs, rate_variance, status)
        return self._output

    @property
    def learned_model(self) -> SlipModel:
        """The slip model that was come to, with its covariance and the residuals assumed."""
        names = ("slip_std_ratio", "angle_std_rad", "correlation_s")
        return model_of(
            np.array(self.filter.mean[_MODEL]),
            covariance=self.filter.cov[_MODEL, _MODEL],
            found="fixes while driving",
            **{name: getattr(self._model, name) for name in names},
        )

    def _output_of(self, inputs: Array, rate_variance: float, status: ObserverStatus) -> ObserverOutput:
        settings, belts, moves = self._settings, inputs[:2], bool(inputs[:2].any())
        mean, std = self.read(_read, inputs)
        std[3] = math.hypot(std[3], math.sqrt(0.5) * settings.encoder_noise_mps * moves)
        std[5] = math.sqrt(std[5] ** 2 + rate_variance)
        slip, slip_std = np.full(3, np.nan), np.full(3, np.nan)
        v_x, v_y, rate = mean[3:6].tolist()
        ground = v_x + np.array([-self._half_m, self._half_m]) * rate
        fastest = np.maximum(np.abs(belts), np.abs(ground))
        if moves:
            known = fastest >= settings.min_speed_mps
            slip[:2][known] = np.clip((belts - ground)[known] / fastest[known], -1.0, 1.0)
            slip_std[:2][known] = std[3] / fastest[known]
            square = v_x**2 + v_y**2
            if square >= settings.min_speed_mps**2:
                slip[2] = math.atan2(v_y, abs(v_x))
                slip_std[2] = math.hypot(abs(v_x) * std[4], v_y * std[3]) / square
        unknown = np.append(np.zeros(6, bool), std[6:] > OBSERVED_RATIO * self._prior)
        mean[unknown] = std[unknown] = np.nan
        d, n = len(self.states), len(self.slips)
        return ObserverOutput(mean[:d], std[:d], slip[:n], slip_std[:n], int(status))


def plain_odometry(name: str, robot: TrackedRobot, model: SlipModel = NO_SLIP) -> SlipOdometry:
    """Return one of the odometries that know no slip, or of turns alone; see the table of this module.

    Parameters
    ----------
    name : ``encoder-odometry``, ``gyrodometry`` or ``endo``
    robot : its tracks
    model : its effective distance of the tracks is that of encoder odometry, its exponent that of Endo's law

    Examples
    --------
    >>> from terrain.robots import load_robot
    >>> plain_odometry("encoder-odometry", load_robot("patako"), SlipModel(track_ratio=1.5)).slips
    ()
    """
    covariance = np.zeros((N_MODEL, N_MODEL))
    covariance[TRACK_RATIO, TRACK_RATIO] = TRACK_STD_RATIO**2
    known = SlipModel(
        turning_exponent=model.turning_exponent if name == "endo" else 1.0,
        track_ratio=model.track_ratio if name == "encoder-odometry" else 1.0,
        covariance=covariance,
        run_slip_std_ratio=UNKNOWN_SLIP_RATIO,
        run_angle_std_rad=UNKNOWN_ANGLE_RAD,
    )
    thresholds = {"encoder-odometry": math.inf, "gyrodometry": GYRODOMETRY_THRESHOLD_RADPS, "endo": 0.0}
    settings = OdometrySettings(gyro_threshold_radps=thresholds[name])
    return SlipOdometry(robot, known, settings, name)
