"""The adaptive identity observer of tracked vehicles: how much of its speed each track brings to the ground.

Source: R. Tazzari, I. A. Azzollini and L. Marconi, An Adaptive Observer Approach to Slip Estimation for
Agricultural Tracked Vehicles.  With the efficiency ``n = V_t / v`` of each track (4), the speed over ground
of the track over its circumferential speed, ``i = 1 - n`` the slip of the paper, and the regressor M of the pose z
(columns are left and right)::

    V_G = (n_R v_R + n_L v_L) / 2      Omega = (n_R v_R - n_L v_L) / (2 d)      z' = M n              (5)

    M = [ cos(theta) v_L / 2     cos(theta) v_R / 2 ]
        [ sin(theta) v_L / 2     sin(theta) v_R / 2 ]
        [ -v_L / (2 d)           v_R / (2 d)        ]

    z^' = M(theta) n^ + L e            n^' = Lambda M(theta)' e            e = z - z^               (8)

State: pose z^ and n^.  Measured: z, from satellites and a compass, and the speeds of the tracks; the yaw rate
of a gyro where there is one.

- Speeds come at every tick, fixes of the pose now and then.  Between two fixes M is integrated with the
  heading that follows from the last measured one by the gyro, else by the estimate; what the heading differs
  by at the next fix is spread over the interval.  At a fix (8) is integrated over the interval since the fix
  before.  The pose in between is dead reckoning, its heading by the gyro where there is one.
- A fix is position and heading at one tick.  One that deviates from the dead reckoning by more than noise and
  the distance that the tracks turned is rejected, and is not used for the efficiencies.
- A track that stands turns nothing, so that its efficiency stays as it is; while both stand the pose follows
  the fixes, low-pass filtered by L.
- Standard deviations are those of the noise of fixes and a random walk of the efficiencies, propagated
  through the errors' own linear map; the noise of one fix acts in two intervals, and its covariance with the
  errors is kept.  Dead reckoning adds the heading's deviation times the distance since the last fix.
- Where efficiencies change, the observation error is larger than its variance explains; their standard
  deviations are then larger by the same ratio.
- Excitation: the smallest eigenvalue of the mean of M'M, forgotten with the time constant T, as a speed (its
  root); T times its square is the mu of (14).

**The interval between two fixes**, by the implicit midpoint rule.  Let W be the integral of M over the interval, h its
length, and dz the difference of the fixes; with ``e_m = (e_0 + e_1) / 2`` and ``n_m`` so::

    z^_1 = z^_0 + W n_m + h L e_m                      n^_1 = n^_0 + Lambda W' e_m
    A e_m = e_0 + (dz - W n^_0) / 2                    A = I + h L / 2 + W Lambda W' / 4

A is symmetric and at least I: the step exists for any gains and any interval.  It never makes errors larger: with the
true efficiency constant, ``dz = W n``, and ``n~ = n^ - n``::

    e_1 - e_0 = -W n~_m - h L e_m                      n~_1 - n~_0 = Lambda W' e_m
    V = (e'e + n~' Lambda^-1 n~) / 2
    V_1 - V_0 = e_m'(e_1 - e_0) + n~_m' Lambda^-1 (n~_1 - n~_0)
              = -e_m' W n~_m - h e_m' L e_m + n~_m' W' e_m  =  -h e_m' L e_m  <=  0

exactly, as a quadratic form changes by its gradient at the midpoint; no step size enters.  A projection of n^ onto
limits that contain n lowers V further where Lambda is diagonal.  Where Lambda changes from interval to interval
(normalised gain), V is that of the interval.  Errors ``x = (z_true - z^, n - n^)`` with noise w of a fix, interpolated
as the fixes are, follow ``x_1 = F x_0 + G w_m``::

    F = [ 2 A^-1 - I          A^-1 W                        ]      G = [ -2 (I - A^-1)        ]
        [ -Lambda W' A^-1     I - Lambda W' A^-1 W / 2      ]          [ -Lambda W' A^-1      ]

Where h L is large, the interval is cut into equal parts with the same mean regressor: V falls in each.

Corrected: (11), whose second row as printed makes M'M singular, has the signs of (8); (14) is over t to
t + T; the heading error of (9) is wrapped to (-pi, pi]; V above (13) has ``e' L^-1 e``, whose cross terms cancel for
L = I only.  At constant gains the settling time goes with 1/v^2; ``normalised`` makes it the same at every speed.  A
slip that the model does not know, sideways on a slope or of a dragged track, is no part of (5).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from terrain.angles import wrapped
from terrain.estimation.models.observer import Observer, ObserverOutput, ObserverStatus
from terrain.records import Array
from terrain.robots import TrackedRobot

ROWS = ("speed_left_mps", "speed_right_mps", "position_x_m", "position_y_m", "yaw_rad", "yaw_rate_radps")
STATES = (
    *("position_x_m", "position_y_m", "yaw_rad", "speed_x_mps", "yaw_rate_radps"),
    *("eta_left_ratio", "eta_right_ratio", "excitation_mps", "observation_error_m"),
)
"""The observation error is |e|, a radian counted as a metre: ``|e|^2 / 2`` is the part of V that is known."""
SLIPS = ("slip_left_ratio", "slip_right_ratio")

PART, MAX_PARTS = 0.25, 64
"""Largest product of a part's length and a rate of the error system: the rule is then right to 0.5 %; most parts."""
MISFIT_S = 1.0
"""Over which the observation error is compared with its variance: about as long as efficiencies lag."""

_FURTHEST_M = 1e8  # no position on Earth is further from an origin on it
_FASTEST_RADPS = 50.0  # no gyro of a robot measures more
_PUSHED_RADPS = 0.05  # above the bias of a gyro
_LONGEST_S = 1e9  # at which clocks of a memory stop


class TrackedSettings(NamedTuple):
    """Gains, noise and limits; the defaults are the gains of the paper, both matrices the identity."""

    #: l_1, l_2 and l_3 of (8), of position and heading
    observation_gain_ps: tuple[float, float, float] = (1.0, 1.0, 1.0)
    #: lambda of (8), of the left and of the right track; not used where ``normalised``
    adaptation_gain: tuple[float, float] = (1.0, 1.0)
    #: adaptation gain ``((M' L^-2 M) + regularisation)^-1 / 4``, critically damped at every speed
    normalised: bool = False
    #: of the regularisation: below about this speed of a track a normalised gain vanishes
    least_speed_mps: float = 0.05
    position_std_m: float = 0.02  #: of a fix, one axis
    yaw_std_rad: float = math.radians(0.5)
    eta_std_ratio: float = 0.3  #: of a track's efficiency before anything is known, about 1
    #: random walk of an efficiency while the robot moves, per square root of a second
    eta_walk_ratio: float = 0.002
    eta_max_ratio: float = 2.0  #: largest efficiency; the least is 0, see (4)
    standing_mps: float = 0.02  #: a slower track stands
    speed_max_mps: float = 10.0  #: a faster track is a wrong measurement
    #: deviation of a fix, in standard deviations of two fixes' difference, that noise may explain
    gate_std: float = 5.0
    n_reset: int = 10  #: fixes rejected one after another after which the pose begins anew
    predicted_after_s: float = 0.5  #: time without a fix after which the status says so
    longest_interval_s: float = 2.0  #: between two fixes, for the later one to be compared with the earlier
    longest_step_s: float = 0.5  #: between two ticks, for the travel between them to be known
    window_s: float = 5.0  #: T of (14), the time constant with which excitation is forgotten
    gyro_std_radps: float = 0.002  #: error of the gyro's rate that stays the same between two fixes


IN_MANOEUVRES = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True, eta_walk_ratio=0.03)
"""Gains of the adaptive observer for logs of any driving: as fast at every speed, and efficiencies that
change by a tenth within some seconds, as from straight motion to a turn.  Squared errors over their variance
are then 1 to 2 in manoeuvres and well below 1 in steady motion.  The paper's gains, for slip that stays as it
is, are the defaults."""


def normalised_gain(travel: Array, span_s: float, gain_ps: Array, least: float) -> Array:
    """Return the adaptation gain (2, 2) that damps the error system critically at every speed.

    ``Lambda = (M' L^-2 M + r I)^-1 / 4`` with the mean regressor ``M = W / h`` and r, which keeps the gain finite where
    a track stands: for ``L = l I`` this is ``(l^2 / 4) (M'M)^-1``, and position and heading with gains of their own
    are both critically damped.

    Examples
    --------
    >>> travel = np.array([[0.03, 0.03], [0.0, 0.0], [-0.06, 0.06]])
    >>> normalised_gain(travel, 0.1, np.array([2.0, 2.0, 2.0]), 0.0).round(3)
    array([[3.472, 2.083], [2.083, 3.472]])
    """
    scaled = travel / (span_s * gain_ps[:, None])
    return np.asarray(0.25 * np.linalg.inv(scaled.T @ scaled + least * np.eye(2)))


def n_parts(travel: Array, span_s: float, gain_ps: Array, adaptation: Array) -> int:
    """Return into how many parts an interval is cut."""
    coupling = float(np.sum(travel @ adaptation * travel))
    fastest = max(span_s * float(gain_ps.max()), math.sqrt(max(coupling, 0.0)))
    return max(1, min(MAX_PARTS, math.ceil(fastest / PART - 1e-9)))


def observe_interval(
    travel: Array,
    span_s: float,
    gain_ps: Array,
    adaptation: Array,
    error: Array,
    eta: Array,
    moved: Array,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the errors and efficiencies at the end of an interval, and how their errors propagate.

    Parameters
    ----------
    travel, span_s, gain_ps, adaptation, moved : W (3, 2), h, the diagonal of L (3,), Lambda (2, 2) and dz (3,)
    error, eta : e (3,), measured pose less estimated, and efficiencies (2,) at the start

    Returns
    -------
    error, eta : at the end
    whole, from_start, from_end : F (5, 5), and how the noise of either fix enters, (5, 3)

    Examples
    --------
    >>> travel = np.array([[0.03, 0.03], [0.0, 0.0], [-0.06, 0.06]])  # 0.6 m/s for 0.1 s, d = 0.5 m
    >>> moved = travel @ np.array([0.8, 0.8])
    >>> error, eta, *_ = observe_interval(travel, 0.1, np.ones(3), np.eye(2), np.zeros(3), np.ones(2), moved)
    >>> error.round(4), eta.round(5)
    (array([-0.0114,  0.    ,  0.    ]), array([0.99983, 0.99983]))
    """
    n = n_parts(travel, span_s, gain_ps, adaptation)
    w, h, dz = travel / n, span_s / n, moved / n
    k = adaptation @ w.T
    inverse = np.linalg.inv(np.eye(3) + np.diag(0.5 * h * gain_ps) + 0.25 * (w @ k))
    gain = k @ inverse
    part_map = np.block([[2.0 * inverse - np.eye(3), inverse @ w], [-gain, np.eye(2) - 0.5 * (gain @ w)]])
    noise_map = np.vstack([2.0 * (inverse - np.eye(3)), -gain])
    whole, from_start, from_end = np.eye(5), np.zeros((5, 3)), np.zeros((5, 3))
    for j in range(n):
        middle = inverse @ (error + 0.5 * (dz - w @ eta))
        error = 2.0 * middle - error
        eta = eta + k @ middle
        later = (j + 0.5) / n
        from_start = part_map @ from_start + (1.0 - later) * noise_map
        from_end = part_map @ from_end + later * noise_map
        whole = part_map @ whole
    return error, eta, whole, from_start, from_end


class TrackedObserver(Observer):
    """The adaptive observer of a tracked vehicle; excitation and observation error have no standard deviation.

    Parameters
    ----------
    robot : tracked
    settings : gains, noise and limits

    Examples
    --------
    >>> from terrain.estimation.models.observer import observe
    >>> from terrain.robots import load_robot
    >>> time_s = np.arange(0.0, 20.0, 0.1)
    >>> rows = np.tile([0.6, 0.6, 0.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    >>> rows[:, 2] = 0.87 * 0.6 * time_s
    >>> track = observe(TrackedObserver(load_robot("orchard_ugv"), TrackedSettings()), time_s, rows)
    >>> track.slip[-1].round(3), ObserverStatus(track.status[-1]).name
    (array([0.128, 0.128]), 'OK')
    """

    name, states, slips, rows = "tracked", STATES, SLIPS, ROWS

    def __init__(self, robot: TrackedRobot, settings: TrackedSettings = IN_MANOEUVRES) -> None:
        self._settings, self._half_m = settings, robot.half_track_m
        self._variance = np.square([settings.position_std_m, settings.position_std_m, settings.yaw_std_rad])
        self.eta, self._was_observed = np.ones(2), np.zeros(2, bool)
        self.cov = np.diag([0.0, 0.0, 0.0, *np.full(2, settings.eta_std_ratio**2)])
        self._cross = np.zeros((5, 3))  # covariance of the errors with the noise of the last fix
        self._speed_mps, self._direction = (0.0, 0.0), np.ones(2)
        self._pending_s = 0.0  # of ticks without speeds
        self._excitation = np.zeros(3)  # mean of M'M: LL, LR, RR
        self._misfit = 0.0  # square of the observation error over its variance, smoothed
        self._has_started, self._fix, self._error = False, np.zeros(3), np.zeros(3)
        self._begin_interval(0.0)

    def _begin_interval(self, heading_rad: float) -> None:
        """Drop the travel W, its time h and the distance that the faster track turned before a fix."""
        self._travel, self._span_s, self._path_m = np.zeros((3, 2)), 0.0, 0.0
        self._is_broken = self._is_unaided = False  # travel unknown; without a gyro
        self._heading_rad, self._n_rejected = heading_rad, 0

    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row of :data:`ROWS`; pose and slip are NaN before anything was observed."""
        settings, (left, right, *fix, rate) = self._settings, row.tolist()
        if not (
            0.0 <= dt_s < math.inf
            and max(abs(left), abs(right)) <= settings.speed_max_mps
            and left + right == left + right
        ):
            if dt_s > 0.0:
                self._pending_s = min(self._pending_s + dt_s, _LONGEST_S)
            return self._read(ObserverStatus.BAD_INPUT)
        dt_s, self._pending_s = min(dt_s, _LONGEST_S) + self._pending_s, 0.0
        left, right = (0.0 if abs(speed) < settings.standing_mps else speed for speed in (left, right))
        stands = left == right == 0.0
        if not abs(rate) <= _FASTEST_RADPS:
            rate = math.nan
        elif stands and abs(rate) < _PUSHED_RADPS:
            rate = 0.0
        self._move_on(left, right, rate, dt_s)
        status = None if math.isnan(sum(fix)) else self._take_fix(np.array(fix))
        if status is None:
            if not self._has_started:
                status = ObserverStatus.STARTING
            elif stands:
                status = ObserverStatus.PUSHED if abs(rate) >= _PUSHED_RADPS else ObserverStatus.STANDING
            elif self._span_s > settings.predicted_after_s:
                status = ObserverStatus.PREDICTED
            else:
                status = ObserverStatus.UNEXCITED if left == 0.0 or right == 0.0 else ObserverStatus.OK
        return self._read(status)

    def _move_on(self, left: float, right: float, rate: float, dt_s: float) -> None:
        """Integrate M over a tick: speeds at its end, 0 of a track that stands, and its mean yaw rate."""
        settings, half = self._settings, 0.5 / self._half_m
        mean_left, mean_right = 0.5 * (self._speed_mps[0] + left), 0.5 * (self._speed_mps[1] + right)
        self._speed_mps = left, right
        if math.isnan(rate):
            self._is_unaided = True
            rate = half * float(self.eta[1] * mean_right - self.eta[0] * mean_left)
        turn = dt_s * rate
        if dt_s > settings.longest_step_s:
            self._is_broken = True
        else:
            middle = self._heading_rad + 0.5 * turn
            cos, sin = 0.5 * math.cos(middle), 0.5 * math.sin(middle)
            self._travel += [
                [cos * mean_left * dt_s, cos * mean_right * dt_s],
                [sin * mean_left * dt_s, sin * mean_right * dt_s],
                [-half * mean_left * dt_s, half * mean_right * dt_s],
            ]
            self._heading_rad += turn
            self._path_m += max(abs(mean_left), abs(mean_right)) * dt_s
        self._span_s = min(self._span_s + dt_s, _LONGEST_S)
        near, far = 0.25 + half * half, 0.25 - half * half
        squares = near * mean_left * mean_left, far * mean_left * mean_right, near * mean_right * mean_right
        self._excitation -= math.expm1(-dt_s / settings.window_s) * (np.array(squares) - self._excitation)
        if left != 0.0 or right != 0.0:
            most = settings.eta_std_ratio**2
            for i in (3, 4):
                if self.cov[i, i] < most:
                    self.cov[i, i] = min(self.cov[i, i] + settings.eta_walk_ratio**2 * dt_s, most)
        for j, speed in enumerate(self._speed_mps):
            if speed != 0.0:
                self._direction[j] = math.copysign(1.0, speed)

    def _take_fix(self, fix: Array) -> ObserverStatus | None:
        """Use, reject or begin anew at a fix; return the status that it gives, None for none of its own.

        It is plausible where noise, and efficiencies from 0 to 2, explain how it deviates from dead reckoning.
        """
        settings, has_started, path_m = self._settings, self._has_started, self._path_m
        if not (np.abs(fix[:2]).max() <= _FURTHEST_M and math.isfinite(fix[2])):
            return ObserverStatus.REJECTED
        if has_started:
            off_x, off_y = (fix - self._fix - self._travel @ self.eta)[:2].tolist()
            n_std = math.sqrt(2.0) * settings.gate_std
            turn = n_std * settings.yaw_std_rad + path_m / self._half_m
            is_near = math.hypot(off_x, off_y) <= n_std * settings.position_std_m + path_m
            is_near = is_near and abs(wrapped(float(fix[2]) - self._heading_rad)) <= turn
            if not (self._is_broken or is_near):
                self._n_rejected += 1
                if self._n_rejected < settings.n_reset:
                    return ObserverStatus.REJECTED
            elif not self._is_broken and self._span_s <= settings.longest_interval_s:
                if self._span_s > 1e-6:
                    self._correct(fix)
                return None
        self._has_started, self._fix, self._error = True, fix, np.zeros(3)
        self.cov[:3, :], self.cov[:, :3], self._cross = 0.0, 0.0, np.zeros((5, 3))
        self.cov[:3, :3], self._cross[:3] = np.diag(self._variance), -np.diag(self._variance)
        self._begin_interval(float(fix[2]))
        return ObserverStatus.RESET if has_started else None

    def _correct(self, fix: Array) -> None:
        """Integrate the observer from the last fix to this one."""
        settings, span_s, variance = self._settings, self._span_s, self._variance
        late = wrapped(float(fix[2]) - self._heading_rad)
        cos, sin = math.cos(0.5 * late), math.sin(0.5 * late)
        travel = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ self._travel
        moved = np.append(fix[:2] - self._fix[:2], self._heading_rad + late - self._fix[2])
        gain = np.array(settings.observation_gain_ps)
        adaptation = np.diag(settings.adaptation_gain)
        if settings.normalised:
            adaptation = normalised_gain(travel, span_s, gain, 0.25 * settings.least_speed_mps**2)
        error, eta, whole, from_start, from_end = observe_interval(
            travel, span_s, gain, adaptation, self._error, self.eta, moved
        )
        turned = (travel != 0.0).any(axis=0)
        self.eta = np.where(turned, np.clip(eta, 0.0, settings.eta_max_ratio), self.eta)
        self._was_observed |= turned
        error[2] = wrapped(error[2])
        shared = whole @ self._cross @ from_start.T
        fresh = whole @ self.cov @ whole.T + shared + shared.T
        fresh += (from_start * variance) @ from_start.T + (from_end * variance) @ from_end.T
        self.cov, self._cross = 0.5 * (fresh + fresh.T), from_end * variance
        self._error, self._fix = error, fix
        square = float(error @ np.linalg.solve(self.cov[:3, :3] + np.diag(variance), error)) / 3.0
        self._misfit -= math.expm1(-span_s / MISFIT_S) * (square - self._misfit)
        self._begin_interval(float(fix[2]))

    def _read(self, status: ObserverStatus) -> ObserverOutput:
        mean, std = np.full(9, np.nan), np.full(9, np.nan)
        half, eta, cov = 0.5 / self._half_m, self.eta, self.cov
        (left, right), wider = self._speed_mps, max(self._misfit, 1.0)
        ll, lr, rr = (float(cov[i, j]) * wider for i, j in ((3, 3), (3, 4), (4, 4)))
        mean[3], mean[4] = 0.5 * (eta[0] * left + eta[1] * right), half * (eta[1] * right - eta[0] * left)
        common, cross = left * left * ll + right * right * rr, 2.0 * left * right * lr
        std[3], std[4] = 0.5 * math.sqrt(max(common + cross, 0.0)), half * math.sqrt(max(common - cross, 0.0))
        mean[5:7], std[5:7] = eta, np.sqrt([ll, rr])
        a, b, c = self._excitation.tolist()
        mean[7] = math.sqrt(max(0.5 * (a + c) - math.hypot(0.5 * (a - c), b), 0.0))
        if self._has_started:
            u, v = self._travel.T
            ahead = u * eta[0] + v * eta[1]
            mean[:3] = self._fix - self._error + ahead
            variance = cov.diagonal()[:3] + u * u * ll + 2.0 * u * v * lr + v * v * rr
            variance += 2.0 * (u * cov[:3, 3] + v * cov[:3, 4])
            if not self._is_unaided:
                mean[2] = self._heading_rad - self._error[2]
                variance[2] = cov[2, 2] + (self._settings.gyro_std_radps * self._span_s) ** 2
            # half of what the heading is off by at the end acts on the distance since the fix
            heading = self._settings.yaw_std_rad**2 + 0.25 * max(variance[2] - cov[2, 2], 0.0)
            variance[:2] += ahead[[1, 0]] ** 2 * heading
            std[:3] = np.sqrt(np.maximum(variance, 0.0))
            mean[2] = wrapped(mean[2])
            mean[8] = math.sqrt(float(self._error @ self._error))
        larger, known = np.maximum(eta, 1.0), self._was_observed
        slip = np.where(known, self._direction * (1.0 - eta) / larger, np.nan)
        return ObserverOutput(mean, std, slip, np.where(known, std[5:7] / larger**2, np.nan), int(status))
