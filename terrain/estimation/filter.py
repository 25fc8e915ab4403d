"""One extended Kalman step for every filter, in a batch or sample by sample.

State x (d,) with covariance P, measurement z (m,) with independent rows of variance R, functions f and h::

    predict       x <- f(x, dt)              P <- F P F' + Q dt                 F = df/dx
    condition on  nu = z - h(x), s = H P H' + R, K = P H' / s                   H = dh/dx
                  x <- x + K nu              P <- P - K H P - P H' K' + K s K'  (Joseph form)

h and H are evaluated once a step, at the predicted state, and the rows conditioned on one by one: the same
answer as all at once, in O(m d^2) and without inverting a matrix.

What arrives is not trusted.  Missing values (NaN) are skipped; so are infinite ones, and counted.  What
disagrees with the prediction beyond the gate of its sensor is left out, and believed once after a while, so
that a filter that went wrong finds back.  A jump of the clock is believed when the next stamp follows it, and
is not integrated over.  Nothing that comes in makes what comes out infinite or NaN.

Loops are written out: at these sizes the assignment of a slice costs as much as a measurement.  The plain form
is in the tests.

Source: the form of the step follows the textbook of Sarkka, Bayesian Filtering and Smoothing (2013), 5.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numba import float64, void
from numba.core.errors import NumbaError
from numba.core.types.function_type import CompileResultWAP
from scipy.special import chdtri

from terrain.angles import wrapped
from terrain.errors import ConfigError, DataError, LogError
from terrain.kernels import filled, inner, njit, record
from terrain.logs.schema import unit_of
from terrain.records import ABSENT, GATED, REOPENED, USED, Array, StateTrack, read_only

#: Five standard deviations: a wheel that starts to slip is a surprise of four, and no fault.
GATE_PROBABILITY = 1.0 - 1e-6
#: Spikes last a sample or two; what disagrees for longer is the ground's doing, a brake or a bump.
REOPEN_AFTER_S = 0.2
HELD_S = 2.0  #: A sensor that the model holds is not reopened before this time.
#: No state or measurement of a ground robot in SI units comes near: what does is taken for garbage.
LARGEST = 1e9

WIDEST = LARGEST**4

#: After a longer gap a position is no less certain than after this one: that is nowhere already.
LONGEST_GAP_S = 3600.0
#: Room in the records for states, rows and sensors: every filter is one type for the compiled step.
MOST = 32

_SLACK_S = 1e-9  # what sums of steps may be off by

_VECTOR, _MATRIX = float64[::1], float64[:, ::1]
_SIGNATURES = {
    "propagate": void(_VECTOR, float64, _VECTOR, _VECTOR, _MATRIX),
    "observe": void(_VECTOR, _VECTOR, _VECTOR, _MATRIX),
}


@dataclass(frozen=True, eq=False)
class FilterModel:
    """What a filter estimates, and from what.

    Raises
    ------
    ConfigError
        where a name has no unit, is given twice or refers to nothing, a length does not fit, or a function is
        none of numba.
    """

    name: str  #: what reports call it
    states: tuple[str, ...]  #: d states and m measurements, each name ending in its unit
    rows: tuple[str, ...]
    #: name and rows of each sensor, in the order in which they are judged, each after those before; a sensor is
    #: believed or left out as a whole, and every row belongs to one
    sensors: tuple[tuple[str, tuple[str, ...]], ...]
    #: ``propagate(x, dt, params, x_next, F)`` writes the next state (d,), and the entries of the Jacobian that are
    #: not zero: F (d, d) comes as zeros, and rows that stay short cost less
    propagate: Any
    #: ``observe(x, params, z_hat, H)`` writes the measurement expected (m,), and the entries of H (m, d) that are not
    #: zero.  Both are functions of numba, ``@njit``
    observe: Any
    params: Array  #: what the two functions need of the robot; the inputs of a sample stand behind them
    initial_std: Array  #: (d,) how little is known of each state where nothing is known
    initial_mean: Array = field(default_factory=lambda: np.zeros(0))  #: (d,) zeros without
    #: names of what is known of each step beside the state; 0 where it is not given
    inputs: tuple[str, ...] = ()
    references: tuple[str, ...] = ()  #: sensors of the speed over ground
    #: sensors that are not reopened before two seconds: those that fail, rather than show the ground's doing
    held: tuple[str, ...] = ()
    #: states that a gap in the data leaves where they were, with a covariance that grew
    positions: tuple[str, ...] = ()
    angle_states: tuple[str, ...] = ()  #: states that are wrapped to (-pi, pi], and rows whose innovation is
    angle_rows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        place, shape = f"filter {self.name}", (len(self.states),)
        if not len(self.initial_mean):
            object.__setattr__(self, "initial_mean", np.zeros(shape))
        for name in ("params", "initial_std", "initial_mean"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
            if name != "params" and getattr(self, name).shape != shape:
                raise ConfigError(f"{place}: {name} has shape {getattr(self, name).shape}, {shape} is needed")
        if not (np.isfinite(self.initial_std).all() and (self.initial_std > 0).all()):
            raise ConfigError(
                f"{place}: initial_std {self.initial_std.tolist()} must be above zero and finite"
            )
        self._check_names(place)
        for name, signature in _SIGNATURES.items():
            function = getattr(self, name)
            if tuple(signature.args) not in getattr(function, "signatures", ()):
                try:
                    function.compile(signature)
                except (AttributeError, RuntimeError, TypeError, NumbaError):
                    raise ConfigError(f"{place}: {name} must be @njit, and take {signature}") from None

    def _check_names(self, place: str) -> None:
        for name in (*self.states, *self.rows):
            try:
                unit_of(name)
            except LogError as error:
                raise ConfigError(f"{place}: {str(error).replace('channel', 'state or row')}") from None
        sensors, grouped = self.sensor_names, [row for _, rows in self.sensors for row in rows]
        given = {"states": self.states, "rows": self.rows, "sensors": sensors, "inputs": self.inputs}
        for what, names in given.items():
            if len(set(names)) < len(names):
                raise ConfigError(f"{place}: {what} {list(names)} name one of them twice")
            if len(names) > MOST:
                raise ConfigError(f"{place}: there are {len(names)} {what}, at most {MOST} are possible")
        if sorted(grouped) != sorted(self.rows):
            raise ConfigError(f"{place}: its sensors must hold every row once; they hold {grouped}")
        referring = {"references": sensors, "held": sensors, "positions": self.states}
        referring |= {"angle_states": self.states, "angle_rows": self.rows}
        for what, known in referring.items():
            for unknown in (name for name in getattr(self, what) if name not in known):
                raise ConfigError(f"{place}: {what} name {unknown!r}, which is none of {', '.join(known)}")

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Name of each sensor."""
        return tuple(name for name, _ in self.sensors)


@dataclass(frozen=True, eq=False)
class Noise:
    """How much a model is off: variances in squared natural units, as ``0.02**2``.

    Raises
    ------
    ConfigError
        where a shape does not fit, or something is not finite, not symmetric or not positive (semi)definite.

    Examples
    --------
    >>> Noise([0.1**2], np.diag([0.01**2, 0.02**2]))
    Traceback (most recent call last):
    terrain.errors.ConfigError: measurement_variance is a matrix: rows are taken as independent, give (m,)
    """

    process_variance: Array  #: (d,) or (d, d), **per second**: a step of dt adds Q dt
    #: (m,) of each row, or (n, m) where it changes from sample to sample (of a sample whose variance is NaN, zero or
    #: negative, the row is not used); rows are independent
    measurement_variance: Array
    initial_variance: Array | None = None  #: (d,) or (d, d); what the model says without
    #: (n, d), **per second**, of each sample beside the process variance: for states that change faster at times
    walk_variance: Array | None = None

    def __post_init__(self) -> None:
        for name in ("process_variance", "initial_variance"):
            if (given := getattr(self, name)) is not None:
                object.__setattr__(self, name, _covariance(name, given, definite=name == "initial_variance"))
        if self.walk_variance is not None:
            walk = read_only(self.walk_variance)
            object.__setattr__(self, "walk_variance", walk)
            if walk.ndim != 2 or not ((walk >= 0) & (walk < np.inf)).all():
                raise ConfigError("walk_variance must be (n, d), finite and not below zero")
        r = read_only(self.measurement_variance)
        object.__setattr__(self, "measurement_variance", r)
        if r.ndim not in (1, 2):
            raise ConfigError(f"measurement_variance has shape {r.shape}, (m,) or (n, m) is needed")
        if r.ndim == 2 and r.shape[0] == r.shape[1] > 1 and (r == r.T).all() and np.ptp(r) > 0:
            raise ConfigError("measurement_variance is a matrix: rows are taken as independent, give (m,)")
        if r.ndim == 1 and not ((r > 0) & np.isfinite(r)).all():
            raise ConfigError(f"measurement_variance {r.tolist()} must be above zero and finite")

    def at(self, samples: Array) -> Noise:
        """Return the noise of some samples (k,) by number, where it changes from sample to sample."""
        r, walk = self.measurement_variance, self.walk_variance
        r, walk = r[samples] if r.ndim == 2 else r, None if walk is None else walk[samples]
        return Noise(self.process_variance, r, self.initial_variance, walk)


def _covariance(what: str, given: Any, *, definite: bool) -> Array:
    """Return a covariance (d, d) or the variances (d,) as a checked matrix."""
    array = np.asarray(given, dtype=np.float64)
    if array.ndim not in (1, 2) or array.shape[0] != array.shape[-1] or not array.size:
        raise ConfigError(f"{what} has shape {array.shape}, (d,) or (d, d) is needed")
    matrix = np.diag(array) if array.ndim == 1 else array
    if not np.isfinite(matrix).all():
        raise ConfigError(f"{what} holds a value that is not finite")
    scale = np.abs(matrix).max()
    if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-12 * scale):
        raise ConfigError(f"{what} is not symmetric")
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    if (definite and smallest <= 0) or smallest < -1e-12 * scale:
        kind = "definite" if definite else "semidefinite"
        raise ConfigError(f"{what} is not positive {kind}: its smallest eigenvalue is {smallest:.3g}")
    return read_only((matrix + matrix.T) / 2)


@dataclass(frozen=True)
class FilterSettings:
    """When a measurement or a stamp is not believed; ``ConfigError`` where a value is out of its range.

    Examples
    --------
    >>> FilterSettings(gate_probability=99.99)
    Traceback (most recent call last):
    terrain.errors.ConfigError: gate_probability is 99.99, a number over 0 up to 1 is required
    """

    #: a sensor's squared innovation under the value that chi-square stays under with this probability is believed; 1
    #: believes everything
    gate_probability: float = 0.9999
    #: a sensor that was rejected all this time is believed once.  First the variance of the states that it is put
    #: down to goes back to the initial one, or to what explains the measurement where that is more.  These states are
    #: those that it alone observes; without any, those that no sensor used before it in the row observes; else all
    #: that it does.  A sensor that the model holds takes two seconds at least
    reopen_after_s: float = 1.0
    #: over a longer step nothing is integrated; a log sampled slower than that needs another value
    max_gap_s: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.gate_probability <= 1:
            raise ConfigError(
                f"gate_probability is {self.gate_probability}, a number over 0 up to 1 is required"
            )
        for name in ("reopen_after_s", "max_gap_s"):
            if not 0 < getattr(self, name) < math.inf:
                raise ConfigError(f"{name} is {getattr(self, name)}, seconds above zero are required")


DEFAULT_SETTINGS = FilterSettings()

#: What is fixed by model, noise and settings: places of the rows, sensor by sensor (``order``), and where each sensor
#: begins among them; first state and covariance, what is added to it a second, and the largest squared innovation
#: that is believed, by its number of rows.
MODEL = record(
    {
        **dict.fromkeys(("n_states", "n_rows", "n_sensors", "n_inputs"), int),
        **dict.fromkeys(("order", "starts"), (int, MOST + 1)),
        **dict.fromkeys(
            ("is_reference", "is_held", "is_angle_row", "is_angle_state", "is_position"), (bool, MOST)
        ),
        "x0": (float, MOST),
        **dict.fromkeys(("p0", "q"), (float, (MOST, MOST))),
        "thresholds": (float, MOST + 1),
        **dict.fromkeys(("reopen_after_s", "max_gap_s"), float),
    }
)

STATE = record(
    {
        **dict.fromkeys(("time_s", "pending_time_s", "reference_age_s", "log_likelihood"), float),
        "x": (float, MOST),
        "p": (float, (MOST, MOST)),
        **dict.fromkeys(("use", "nis_dof"), (np.int8, MOST)),
        **dict.fromkeys(("nis", "likelihood", "rejected_s"), (float, MOST)),
        **dict.fromkeys(("not_advanced", "jumps", "lost"), int),
        **dict.fromkeys(("gated", "not_finite", "numerical"), (int, MOST)),
    }
)
"""All that a filter carries from one sample to the next: a copy is a snapshot.

Stamp of the last sample, that of a jump that is not believed yet, time since the speed over ground was
measured; what became of the sensors of the last sample and how likely it was, for how long each was rejected (-1 for
one that was not), and counts of what was left out."""

#: Room to compute in.
_WORK = record(
    {
        **dict.fromkeys(("f", "fp", "h", "p_before"), (float, (MOST, MOST))),
        "rows": (int, MOST),
        **dict.fromkeys(
            ("x_next", "x_before", "z_hat", "nu", "dx", "dx_before", "g", "gain", "rounding", "moved"),
            (float, MOST),
        ),
        "chosen": (bool, MOST),
    }
)

_SKIP, _START, _STEP, _JUMP = range(4)  # what the clock says of a row
_UNSOUND = -1  # a use that is never reported

_inner = inner(error_model="numpy")


@njit(inline="always")
def differentiate(function: Any, x: Array, dt: float, params: Array, y: Array, by_x: Array) -> None:
    """Write ``y`` and its derivatives ``by_x`` of ``function(x, dt, params, y)`` by x, by central differences.

    A model that has it in place of derivatives of its own is two lines: ``propagate`` and ``observe`` call this with
    compiled functions.  Steps of 1e-6 leave 1e-10 of what a function is smooth in.
    """
    at, low, high = x.copy(), np.zeros(y.size), np.zeros(y.size)
    for j in range(x.size):
        step = 1e-6 * max(1.0, abs(x[j]))
        at[j] = x[j] - step
        function(at, dt, params, low)
        at[j] = x[j] + step
        function(at, dt, params, high)
        at[j] = x[j]
        for i in range(y.size):
            by_x[i, j] = (high[i] - low[i]) / (2.0 * step)
    function(x, dt, params, y)


@_inner
def _follows(time_s: float, last_s: float, pending_s: float, max_gap_s: float) -> int:
    """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken.

    A jump is believed where the stamp follows one that jumped before.
    """
    if not math.isfinite(time_s):
        return 0
    step_s = time_s - last_s
    if abs(step_s) > max_gap_s:
        since_jump_s = time_s - pending_s
        believed = since_jump_s > 0.0 and since_jump_s <= max_gap_s
        return (1 if step_s > 0.0 else -1) if believed else 0
    return 0 if step_s <= 0.0 else 1


@_inner
def _read_stamp(model: Any, state: Any, time_s: float) -> tuple[int, float]:
    """Say what the clock does, and move it."""
    dt = time_s - state.time_s
    jumps = abs(dt) > model.max_gap_s  # not the first, whose dt is NaN
    if _follows(time_s, state.time_s, state.pending_time_s, model.max_gap_s) == 0:
        if jumps and np.isfinite(time_s):
            state.jumps += 1
            state.pending_time_s = time_s
        else:
            state.not_advanced += 1
        return _SKIP, dt
    kind = _JUMP if jumps else (_START if np.isnan(dt) else _STEP)
    state.time_s, state.pending_time_s = time_s, np.nan
    return kind, dt


@_inner
def _copy(d: int, p: Array, x: Array, p_to: Array, x_to: Array) -> None:
    """Copy a covariance and a state."""
    for i in range(d):
        x_to[i] = x[i]
        for j in range(d):
            p_to[i, j] = p[i, j]


@_inner
def _predict(model: Any, state: Any, work: Any, dt: float, params: Array, propagate: Any) -> None:
    """x_next = f(x, dt), and P <- F P F' + Q dt, symmetric to the last bit."""
    d, p, f, fp = model.n_states, state.p, work.f, work.fp
    f[:d, :d] = 0.0
    fp[:d, :d] = 0.0
    propagate(state.x[:d], dt, params, work.x_next[:d], f[:d])
    for i in range(d):
        for j in range(d):
            if f[i, j] != 0.0:
                for k in range(d):
                    fp[i, k] += f[i, j] * p[j, k]
    for i in range(d):
        for k in range(i + 1):
            total = model.q[i, k] * dt
            for j in range(d):
                if f[k, j] != 0.0:
                    total += fp[i, j] * f[k, j]
            p[i, k] = total
            p[k, i] = total


@_inner
def _reset_covariance(model: Any, state: Any, chosen: Array) -> None:
    """Put the covariance of the chosen states back to P0, or leave it where it is wider; uncorrelated."""
    p = state.p
    for i in range(model.n_states):
        if chosen[i]:
            variance = min(max(p[i, i], model.p0[i, i]), LARGEST**2)
            for j in range(model.n_states):
                p[i, j] = 0.0
                p[j, i] = 0.0
            p[i, i] = variance


@_inner
def _step(model: Any, state: Any, work: Any, dt: float, walk: Array, params: Array, propagate: Any) -> None:
    """Predict; where that leads out of this world, begin anew but for positions that do not."""
    d, x, p = model.n_states, state.x, state.p
    _copy(d, p, x, work.p_before, work.x_before)
    _predict(model, state, work, dt, params, propagate)
    n_bad = 0
    for i in range(d):
        p[i, i] += walk[i] * dt
        n_bad += not ((abs(work.x_next[i]) <= LARGEST) & (p[i, i] > 0.0) & (p[i, i] <= WIDEST))
        x[i] = work.x_next[i]
    if n_bad > 0:
        _copy(d, work.p_before, work.x_before, p, x)
        for i in range(d):
            work.chosen[i] = not model.is_position[i] or p[i, i] > LARGEST**2
            if not model.is_position[i]:
                x[i] = model.x0[i]
        _reset_covariance(model, state, work.chosen)
        state.lost += 1
    state.reference_age_s += dt
    for k in range(model.n_sensors):
        if state.rejected_s[k] >= 0.0:
            state.rejected_s[k] += dt


@_inner
def _predict_over_gap(model: Any, state: Any, work: Any, dt: float, params: Array, propagate: Any) -> None:
    """Reset all covariances but those of the positions, which grow by what the speeds may have been."""
    d = model.n_states
    for i in range(d):
        work.chosen[i] = not model.is_position[i]
    _reset_covariance(model, state, work.chosen)
    _copy(d, state.p, state.x, work.p_before, work.x_before)
    _predict(model, state, work, min(abs(dt), LONGEST_GAP_S), params, propagate)
    for i in range(d):
        for j in range(d):
            if not (model.is_position[i] and model.is_position[j]):
                state.p[i, j] = work.p_before[i, j]
    # of a clock that was set back the age is unknown
    state.reference_age_s = state.reference_age_s + dt if dt > 0.0 else np.inf
    for k in range(model.n_sensors):
        state.rejected_s[k] = -1.0


@_inner
def _choose_states(model: Any, state: Any, work: Any, k: int) -> None:
    """Mark the states that the rejection of sensor k is put down to.

    Those that it alone observes; without any, those that no sensor used before it in this row observes;
    without any, all that it observes.
    """
    h, order, starts, chosen = work.h, model.order, model.starts, work.chosen
    for attempt in range(3):
        n_chosen = 0
        for j in range(model.n_states):
            chosen[j] = False
            for c in range(starts[k], starts[k + 1]):
                chosen[j] |= h[order[c], j] != 0.0
            for other in range(model.n_sensors):
                used = state.use[other] == USED or state.use[other] == REOPENED
                if other != k and (attempt == 0 or (attempt == 1 and used)):
                    for c in range(starts[other], starts[other + 1]):
                        chosen[j] &= h[order[c], j] == 0.0
            n_chosen += chosen[j]
        if n_chosen > 0:
            return


@_inner
def _innovation(model: Any, state: Any, work: Any, i: int) -> tuple[float, float]:
    """Write g = P h' of row i; return its innovation after what was conditioned on before, and h P h'."""
    d, h, g, nu, spread = model.n_states, work.h[i], work.g, work.nu[i], 0.0
    g[:d] = 0.0
    for column in range(d):
        if h[column] != 0.0:
            nu -= h[column] * work.dx[column]
            for j in range(d):
                g[j] += h[column] * state.p[column, j]
    for column in range(d):
        if h[column] != 0.0:
            spread += h[column] * g[column]
    return nu, spread


@_inner
def _condition_on(model: Any, state: Any, work: Any, nu: float, spread: float, r: float) -> bool:
    """Condition dx and P on one row; return False, and leave them, where that leads out of this world.

    K = g / s with s = h P h' + R.  ``rounding`` is what the Joseph form has beyond P - K g',
    R K - (g - K h g): nothing but rounding, which saves R where it is lost in s beside a large h P h'.
    """
    d, x, p, g, gain, rounding = model.n_states, state.x, state.p, work.g, work.gain, work.rounding
    per_s = 1.0 / (spread + r)
    n_bad = 0
    for i in range(d):
        k = g[i] * per_s
        rest = r * k - (g[i] - k * spread)
        moved = work.dx[i] + k * nu
        variance = (p[i, i] - k * g[i]) + rest * k
        gain[i], rounding[i], work.moved[i] = k, rest, moved
        n_bad += not ((abs(x[i] + moved) <= LARGEST) & (variance > 0.0) & (variance <= WIDEST))
    if n_bad > 0:
        return False
    for i in range(d):
        work.dx[i] = work.moved[i]
    for i in range(d):
        k, rest = gain[i], rounding[i]
        for j in range(d):
            p[i, j] = (p[i, j] - k * g[j]) + rest * gain[j]
    return True


@_inner
def _take_rows(model: Any, state: Any, work: Any, z: Array, variance: Array, k: int) -> int:
    """Write the innovations of a sensor's rows that measured something; return how many did."""
    n_rows = 0
    for c in range(model.starts[k], model.starts[k + 1]):
        i = model.order[c]
        if np.isnan(z[i]):
            continue
        if not (abs(z[i]) <= LARGEST and variance[i] > 0.0 and variance[i] < np.inf):
            state.not_finite[k] += 1
            continue
        nu = z[i] - work.z_hat[i]
        work.nu[i] = wrapped(nu) if model.is_angle_row[i] else nu
        work.rows[n_rows] = i
        n_rows += 1
    return n_rows


@_inner
def _condition_on_sensor(model: Any, state: Any, work: Any, z: Array, variance: Array, k: int) -> None:
    """Condition on all rows of a sensor, or on none: gate it, or reopen it once it was rejected for long."""
    n_rows = _take_rows(model, state, work, z, variance, k)
    if n_rows == 0:
        return
    d, p, dx, rows = model.n_states, state.p, work.dx, work.rows
    if n_rows > 1:  # one row alone is judged before anything changes
        _copy(d, p, dx, work.p_before, work.dx_before)
    use, threshold, square, likelihood = USED, model.thresholds[n_rows], np.nan, 0.0
    for attempt in range(2):
        total, likelihood, sound, definite = 0.0, 0.0, True, True
        for c in range(n_rows):
            r = variance[rows[c]]
            nu, spread = _innovation(model, state, work, rows[c])
            s = spread + r
            definite &= s > 0.5 * r
            total += nu * nu / s
            likelihood -= 0.5 * (math.log(2.0 * math.pi * s) + nu * nu / s)
            if definite and (c < n_rows - 1 or total <= threshold):
                sound &= _condition_on(model, state, work, nu, spread, r)
        if attempt == 0:
            square = total
        if total <= threshold and sound and definite:
            break
        if n_rows > 1 or attempt == 1:
            _copy(d, work.p_before, work.dx_before, p, dx)
        if not definite:  # rounding has made P no covariance: go on without its correlations
            work.chosen[:] = True
            _reset_covariance(model, state, work.chosen)
        if total <= threshold or attempt == 1 or not definite:
            use = _UNSOUND
            break
        state.rejected_s[k] = max(state.rejected_s[k], 0.0)
        after_s = max(model.reopen_after_s, HELD_S) if model.is_held[k] else model.reopen_after_s
        if state.rejected_s[k] < after_s:
            use = GATED
            break
        use, threshold = REOPENED, np.inf
        _copy(d, p, dx, work.p_before, work.dx_before)
        _choose_states(model, state, work, k)
        _reset_covariance(model, state, work.chosen)
        worst = 0.0
        for c in range(n_rows):
            nu, spread = _innovation(model, state, work, rows[c])
            worst = max(worst, nu * nu / (spread + variance[rows[c]]))
        if worst > model.thresholds[1]:  # more than the initial variance explains
            for j in range(d):
                if work.chosen[j]:
                    p[j, j] = min(worst * p[j, j], LARGEST**2)
    if use == _UNSOUND:
        state.numerical[k] += 1
        state.use[k] = GATED
        return
    state.use[k], state.nis[k], state.nis_dof[k] = use, square, n_rows
    if use == GATED:
        state.gated[k] += 1
        return
    state.rejected_s[k] = 0.0 if use == REOPENED else -1.0
    state.likelihood[k] = likelihood
    state.log_likelihood += likelihood
    if model.is_reference[k]:
        state.reference_age_s = 0.0


class _Samples(NamedTuple):
    """Stamps and measurements, variances, walks and inputs of each sample."""

    time_s: Array
    z: Array
    variance: Array
    walk: Array
    inputs: Array


class _Columns(NamedTuple):
    """What is written of each sample: the first five only where they have rows."""

    mean: Array
    cov: Array
    nis_dof: Array
    use: Array
    reference_age_s: Array
    nis: Array
    likelihood: Array
    taken: Array


@njit(error_model="numpy")
def _take(
    model: Any,
    state: Any,
    work: Any,
    params: Array,
    propagate: Any,
    observe: Any,
    samples: _Samples,
    columns: _Columns,
) -> None:
    """Take samples one by one: move the state, and write the columns."""
    model, state, work = model[0], state[0], work[0]
    d, m, n_sensors, x, p = model.n_states, model.n_rows, model.n_sensors, state.x, state.p
    keep = columns.mean.shape[0] > 0
    for n in range(samples.time_s.size):
        kind, dt = _read_stamp(model, state, samples.time_s[n])
        columns.taken[n] = kind != _SKIP
        for k in range(n_sensors):
            state.use[k], state.nis[k], state.nis_dof[k], state.likelihood[k] = ABSENT, np.nan, 0, 0.0
        if kind != _SKIP and kind != _JUMP:
            first = params.size - model.n_inputs
            for i in range(model.n_inputs):
                params[first + i] = samples.inputs[n, i]
        if kind == _STEP:
            _step(model, state, work, dt, samples.walk[n], params, propagate)
        elif kind == _JUMP:
            _predict_over_gap(model, state, work, dt, params, propagate)
        if columns.taken[n]:
            work.h[:m, :d] = 0.0
            observe(x[:d], params, work.z_hat[:m], work.h[:m])
            work.dx[:] = 0.0
            for k in range(n_sensors):
                _condition_on_sensor(model, state, work, samples.z[n], samples.variance[n], k)
            for i in range(d):
                x[i] += work.dx[i]
                if model.is_angle_state[i]:
                    x[i] = wrapped(x[i])
                for j in range(i):
                    p[j, i] = p[i, j]
        for k in range(n_sensors):
            columns.nis[n, k], columns.likelihood[n, k] = state.nis[k], state.likelihood[k]
        if keep:
            columns.reference_age_s[n] = state.reference_age_s
            for k in range(n_sensors):
                columns.use[n, k], columns.nis_dof[n, k] = state.use[k], state.nis_dof[k]
            for i in range(d):
                columns.mean[n, i] = x[i]
                for j in range(d):
                    columns.cov[n, i, j] = p[i, j]


class Filter:
    """A filter in use: a model with its noise, and the state that each sample moves.

    Parameters
    ----------
    model, noise, settings : as of :func:`run_filter`

    Attributes
    ----------
    state : (1,) record :data:`STATE`, all that is remembered: copy it for a snapshot, and assign that to go
        back
    mean, cov : (d,) and (d, d) of the state, views that the next step writes over
    use : (k,) what became of each sensor at the last step

    Raises
    ------
    DataError
        where the noise does not fit the model.

    Examples
    --------
    >>> from terrain.estimation.models.skid import make_skid_filter, skid_noise
    >>> from terrain.robots import load_robot
    >>> robot = load_robot("husky")
    >>> filter = Filter(make_skid_filter(robot), skid_noise(robot))
    >>> filter.step(0.0, np.array([0.4, 0.4, 0.0, np.nan])), filter.step(0.0, np.full(4, np.nan))
    (True, False)
    >>> dict(zip(filter.model.states, filter.mean.round(2), strict=True))["speed_mps"]
    np.float64(0.4)
    """

    def __init__(self, model: FilterModel, noise: Noise, settings: FilterSettings = DEFAULT_SETTINGS) -> None:
        d, m, k = len(model.states), len(model.rows), len(model.sensors)
        self.model, self.noise = model, noise
        self._fixed = _fixed(model, noise, settings)
        self.state = filled(
            STATE, time_s=math.nan, pending_time_s=math.nan, reference_age_s=math.inf, rejected_s=-1.0
        )
        self.mean, self.cov = self.state["x"][0, :d], self.state["p"][0, :d, :d]
        self.use = self.state["use"][0, :k]
        self.mean[:], self.cov[:] = model.initial_mean, self._fixed["p0"][0, :d, :d]
        self.state["nis"] = np.nan
        params = np.append(model.params, np.zeros(len(model.inputs)))
        functions = (  # compiled with their signature: finding them costs more than a step
            CompileResultWAP(getattr(model, name).overloads[tuple(signature.args)])
            for name, signature in _SIGNATURES.items()
        )
        self._kernel = (self._fixed, self.state, filled(_WORK), params, *functions)
        sizes = (m, m, d, len(model.inputs))
        self._sample = _Samples(np.empty(1), *(np.zeros((1, size)) for size in sizes))
        self._nothing = self._columns(1, keep=False)
        self._compiled: Callable[..., None] | None = None

    def step(
        self,
        time_s: float,
        z: Array,
        variance: Array | None = None,
        walk: Array | None = None,
        inputs: Array | None = None,
    ) -> bool:
        """Take in one sample; return False where its stamp did not advance, or jumped.

        Parameters
        ----------
        z : (m,) measurements, NaN where there is none
        variance : (m,) in place of that of the noise, which has to be (m,) without
        walk : (d,) variance per second up to the sample, beside the process variance
        inputs : (k,) of the step up to the sample
        """
        sample = self._sample
        sample.time_s[0], sample.z[0] = time_s, z
        sample.variance[0] = self.noise.measurement_variance if variance is None else variance
        sample.walk[0] = 0.0 if walk is None else walk
        sample.inputs[0] = 0.0 if inputs is None else inputs
        if self._compiled is None:
            _take(*self._kernel, sample, self._nothing)
            (compiled,) = _take.overloads.values()  # its types are found once: that takes longer than a step
            self._compiled = compiled.entry_point
        else:
            self._compiled(*self._kernel, sample, self._nothing)
        return bool(self._nothing.taken[0])

    def run(self, time_s: Array, z: Array, inputs: Array | None = None, *, keep: bool = True) -> _Columns:
        """Take in all samples of a log; return what is known at each, empty columns unless kept."""
        d, m, stamps = len(self.model.states), len(self.model.rows), np.array(time_s, dtype=np.float64)
        n, samples = stamps.size, [stamps]
        for name, array, size in (
            ("z", z, m),
            ("measurement_variance", self.noise.measurement_variance, m),
            ("walk_variance", self.noise.walk_variance, d),
            ("inputs", inputs, len(self.model.inputs)),
        ):
            given = np.zeros((1, size)) if array is None else np.atleast_2d(array)
            if given.shape != (n, size) and (name == "z" or given.shape != (1, size)):
                shape = np.shape(z) if name == "z" else given.shape
                raise DataError(f"filter {self.model.name}: {name} has shape {shape}, {(n, size)} is needed")
            samples.append(np.array(np.broadcast_to(given, (n, size)), dtype=np.float64, order="C"))
        columns = self._columns(n, keep=keep)
        _take(*self._kernel, _Samples(*samples), columns)
        return columns

    def _columns(self, n: int, *, keep: bool) -> _Columns:
        d, k, n_kept = len(self.model.states), len(self.model.sensors), n if keep else 0
        return _Columns(
            np.empty((n_kept, d)),
            np.empty((n_kept, d, d)),
            np.empty((n_kept, k), np.int8),
            np.empty((n_kept, k), np.int8),
            np.empty(n_kept),
            np.empty((n, k)),
            np.empty((n, k)),
            np.zeros(n, np.bool_),
        )

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        last_s, pending_s = (float(self.state[name][0]) for name in ("time_s", "pending_time_s"))
        follows: int = _follows.py_func(time_s, last_s, pending_s, float(self._fixed["max_gap_s"][0]))
        return follows

    def known(self, states: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation of those of some states that the filter has, by name."""
        places = {name: self.model.states.index(name) for name in states if name in self.model.states}
        return {name: (float(self.mean[i]), math.sqrt(float(self.cov[i, i]))) for name, i in places.items()}

    def begin_from(self, known: Mapping[str, tuple[float, float]], age_s: float) -> None:
        """Start from what was known of states, mean and standard deviation, a time ago; ``DataError`` if it runs.

        Each walks for that time; none is believed less than without it, and what the filter does not have is left out.
        """
        if not math.isnan(self.state["time_s"][0]):
            raise DataError("a filter that runs cannot start from another state")
        for name, (mean, std) in known.items():
            if name in self.model.states:
                i = self.model.states.index(name)
                variance = std**2 + float(self.noise.process_variance[i, i]) * age_s
                if variance < self.cov[i, i]:
                    self.mean[i], self.cov[i, i] = mean, variance

    @property
    def reference_age_s(self) -> float:
        """Time since the speed over ground was last measured; infinite before the first."""
        return float(self.state["reference_age_s"][0])

    @property
    def dropped(self) -> dict[str, int]:
        """What was not taken so far, as counts by kind."""
        state = self.state[0]
        counts = {
            "time did not advance": int(state["not_advanced"]),
            "clock jump": int(state["jumps"]),
            "state numerical": int(state["lost"]),
        }
        for k, sensor in enumerate(self.model.sensor_names):
            for kind in ("gated", "not_finite", "numerical"):
                counts[f"{sensor} {kind.replace('_', ' ')}"] = int(state[kind][k])
        return {kind: n for kind, n in counts.items() if n}


def _fixed(model: FilterModel, noise: Noise, settings: FilterSettings) -> Array:
    """Return the record of a model, its noise and the settings, which are checked against it."""
    d, m = len(model.states), len(model.rows)
    for name in ("process_variance", "initial_variance"):
        matrix = getattr(noise, name)
        if matrix is not None and len(matrix) != d:
            raise DataError(f"filter {model.name}: {name} is for {len(matrix)} states, it has {d}")
    if (n_rows := noise.measurement_variance.shape[-1]) != m:
        raise DataError(f"filter {model.name}: measurement_variance is for {n_rows} rows, it has {m}")
    fixed = filled(
        MODEL,
        n_states=d,
        n_rows=m,
        n_sensors=len(model.sensors),
        n_inputs=len(model.inputs),
        reopen_after_s=settings.reopen_after_s - _SLACK_S,
        max_gap_s=settings.max_gap_s + _SLACK_S,
        thresholds=np.inf,
    )
    one = fixed[0]
    one["order"][:m] = [model.rows.index(row) for _, rows in model.sensors for row in rows]
    one["starts"][: len(model.sensors) + 1] = np.cumsum([0, *(len(rows) for _, rows in model.sensors)])
    for name, names, chosen in (
        ("is_reference", model.sensor_names, model.references),
        ("is_held", model.sensor_names, model.held),
        ("is_angle_row", model.rows, model.angle_rows),
        ("is_angle_state", model.states, model.angle_states),
        ("is_position", model.states, model.positions),
    ):
        one[name][: len(names)] = [each in chosen for each in names]
    initial = np.diag(model.initial_std**2) if noise.initial_variance is None else noise.initial_variance
    one["x0"][:d] = model.initial_mean
    one["p0"][:d, :d], one["q"][:d, :d] = initial, noise.process_variance
    dof = np.arange(1.0, 1 + max(len(rows) for _, rows in model.sensors))
    one["thresholds"][1 : 1 + dof.size] = chdtri(dof, 1 - settings.gate_probability)
    return fixed


def run_filter(
    model: FilterModel,
    noise: Noise,
    time_s: Array,
    z: Array,
    settings: FilterSettings = DEFAULT_SETTINGS,
    inputs: Array | None = None,
) -> StateTrack:
    """Filter a whole log.

    Parameters
    ----------
    model : what is estimated, from what
    noise : how much either is off
    time_s : (n,) stamps, at any spacing
    z : (n, m) measurements, NaN where there is none
    settings : gates and gaps
    inputs : (n, k) of the step up to each sample; zeros without

    Returns
    -------
    StateTrack
        ``time_s`` increases strictly.  Left out and counted in ``dropped`` are rows whose stamp does not
        advance; the first row after a jump of more than ``max_gap_s`` forward or back, which is accepted when
        the next stamp follows it (so that one bad stamp costs one row); and, of a clock that was set back,
        the rows up to the time that the track had reached: the filter uses them, the track omits them.

    Raises
    ------
    DataError
        where the shapes do not fit each other, the model or the noise.

    Notes
    -----
    After a jump, means are kept and all covariances but those of the positions go back to the initial one, or
    stay where they were when wider; positions are as uncertain as the speeds that this allows make them over
    the gap.  The means are kept because a logger pauses more often than a drive ends, and because what a gap
    does not change, as a gyro's bias, is best known from before; the covariance makes either harmless.
    """
    session = Filter(model, noise, settings)
    stamps = np.array(time_s, dtype=np.float64)
    columns = session.run(stamps, z, inputs)
    reached = np.maximum.accumulate(np.where(columns.taken, stamps, -np.inf))
    shown = columns.taken & (stamps > np.append(-np.inf, reached[:-1])[: stamps.size])
    dropped = session.dropped
    if not shown.all():
        if set_back := int((columns.taken & ~shown).sum()):
            dropped["clock set back"] = set_back
        stamps, columns = stamps[shown], _Columns(*(column[shown] for column in columns))
    for array in (stamps, *columns):
        array.flags.writeable = False
    return StateTrack(
        stamps,
        columns.mean,
        columns.cov,
        model.states,
        columns.nis,
        columns.nis_dof,
        columns.use,
        model.sensor_names,
        columns.reference_age_s,
        float(session.state["log_likelihood"][0]),
        dropped,
    )
