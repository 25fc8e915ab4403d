"""One extended Kalman step for every filter, in a batch or sample by sample.

State x (d,) with covariance P, measurement z (m,) with independent rows of variance R, functions f and h::

    predict       x <- f(x, dt)              P <- F P F' + Q dt                 F = df/dx
    condition on  nu = z - h(x), s = H P H' + R, K = P H' / s                   H = dh/dx
                  x <- x + K nu              P <- P - K H P - P H' K' + K s K'  (Joseph form)

h and H are evaluated once a step, at the predicted state, and the rows conditioned on one by one: the same
answer as all at once, in O(m d^2) and without inverting a matrix.  A robot, a sensor or a soil is a
:class:`FilterModel` given to this step; there is no second one.

What arrives is not trusted.  Missing values (NaN) are skipped; so are infinite ones, and counted.  What
disagrees with the prediction beyond the gate of its sensor is left out, and believed once after a while, so
that a filter that went wrong finds back.  A jump of the clock is believed when the next stamp follows it, and
is not integrated over.  Nothing that comes in makes what comes out infinite or NaN.

Loops are written out and divisions unchecked: at these sizes the assignment of a slice costs as much as a
measurement.  The plain form is in the tests.

Source: the form of the step follows the textbook of Sarkka, Bayesian Filtering and Smoothing (2013), 5.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numba import float64, void
from numba.core.types.function_type import CompileResultWAP
from scipy.special import chdtri

from terrain.angles import wrapped
from terrain.errors import ConfigError, DataError, LogError
from terrain.kernels import filled, njit, record
from terrain.logs.schema import unit_of
from terrain.records import ABSENT, GATED, REOPENED, USED, Array, StateTrack, read_only

GATE_PROBABILITY = 1.0 - 1e-6
"""Five standard deviations: a wheel that starts to slip is a surprise of four, and no fault."""

REOPEN_AFTER_S = 0.2
"""Spikes last a sample or two; what disagrees for longer is the ground's doing, a brake or a bump."""

HELD_S = 2.0
"""A sensor that the model holds is not reopened before this time."""

LARGEST = 1e9
"""No state or measurement of a ground robot in SI units comes near: what does is taken for garbage."""

WIDEST = LARGEST**4

LONGEST_GAP_S = 3600.0
"""After a longer gap a position is no less certain than after this one: that is nowhere already."""

MAX_STATES = MAX_ROWS = MAX_SENSORS = 32
"""Room in the records: every filter is one type for the compiled step, whatever its size."""

_SLACK_S = 1e-9  # what sums of steps may be off by

_VECTOR, _MATRIX = float64[::1], float64[:, ::1]

PROPAGATE = void(_VECTOR, float64, _VECTOR, _VECTOR, _MATRIX)
"""Signature of ``propagate(x, dt, params, x_next, F)``."""

OBSERVE = void(_VECTOR, _VECTOR, _VECTOR, _MATRIX)
"""Signature of ``observe(x, params, z_hat, H)``."""


@dataclass(frozen=True, eq=False)
class FilterModel:
    """What a filter estimates, and from what.

    Parameters
    ----------
    name : what reports call it
    states : d names, each ending in its unit
    rows : m names of measurements, each ending in its unit
    sensors : name and rows of each sensor, in the order in which they are judged, each after those before; a
        sensor is believed or left out as a whole, and every row belongs to one
    propagate : ``propagate(x, dt, params, x_next, F)`` writes the next state (d,), and the entries of the
        Jacobian that are not zero: F (d, at least d) comes as zeros, and rows that stay short cost less
    observe : ``observe(x, params, z_hat, H)`` writes the measurement expected (m,), and the entries of H
        (m, at least d) that are not zero.  Both are compiled, as ``@njit(PROPAGATE)``
    params : what the two functions need of the robot; the inputs of a sample stand behind them
    inputs : names of what is known of each step beside the state; 0 where it is not given
    initial_std : (d,) how little is known of each state where nothing is known
    initial_mean : (d,) zeros without
    references : sensors of the speed over ground
    held : sensors that are not reopened before two seconds: those that fail, rather than show the ground's
        doing
    positions : states that a gap in the data leaves where they were, with a covariance that grew
    angle_states : states that are wrapped to (-pi, pi]
    angle_rows : rows whose innovation is

    Raises
    ------
    ConfigError
        where a name has no unit, is given twice or refers to nothing, a length does not fit, or a function is
        not compiled as it should be.
    """

    name: str
    states: tuple[str, ...]
    rows: tuple[str, ...]
    sensors: tuple[tuple[str, tuple[str, ...]], ...]
    propagate: Any
    observe: Any
    params: Array
    initial_std: Array
    initial_mean: Array = field(default_factory=lambda: np.zeros(0))
    inputs: tuple[str, ...] = ()
    references: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    positions: tuple[str, ...] = ()
    angle_states: tuple[str, ...] = ()
    angle_rows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not len(self.initial_mean):
            object.__setattr__(self, "initial_mean", np.zeros(len(self.states)))
        for name in ("params", "initial_std", "initial_mean"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        self._check_initial()
        self._check_names()
        for what, signature in (("propagate", PROPAGATE), ("observe", OBSERVE)):
            if tuple(signature.args) not in getattr(getattr(self, what), "signatures", ()):
                raise ConfigError(f"filter {self.name}: {what} must be compiled as @njit({what.upper()})")

    def _check_initial(self) -> None:
        place = f"filter {self.name}"
        for name in ("initial_std", "initial_mean"):
            shape = getattr(self, name).shape
            if shape != (len(self.states),):
                raise ConfigError(f"{place}: {name} has shape {shape}, {(len(self.states),)} is needed")
        if not (np.isfinite(self.initial_std).all() and (self.initial_std > 0).all()):
            raise ConfigError(
                f"{place}: initial_std {self.initial_std.tolist()} must be above zero and finite"
            )

    def _check_names(self) -> None:
        """Refuse a name without a unit, one that is given twice, one that refers to nothing, and too many."""
        place = f"filter {self.name}"
        for name in (*self.states, *self.rows):
            try:
                unit_of(name)
            except LogError as error:
                raise ConfigError(f"{place}: {str(error).replace('channel', 'state or row')}") from None
        grouped = [row for _, rows in self.sensors for row in rows]
        for what, names, most in (
            ("states", self.states, MAX_STATES),
            ("rows", self.rows, MAX_ROWS),
            ("sensors", self.sensor_names, MAX_SENSORS),
            ("inputs", self.inputs, MAX_ROWS),
        ):
            if len(set(names)) < len(names):
                raise ConfigError(f"{place}: {what} {list(names)} name one of them twice")
            if len(names) > most:
                raise ConfigError(f"{place}: there are {len(names)} {what}, at most {most} are possible")
        if sorted(grouped) != sorted(self.rows):
            raise ConfigError(f"{place}: its sensors must hold every row once; they hold {grouped}")
        for what, names, known in (
            ("references", self.references, self.sensor_names),
            ("held", self.held, self.sensor_names),
            ("positions", self.positions, self.states),
            ("angle_states", self.angle_states, self.states),
            ("angle_rows", self.angle_rows, self.rows),
        ):
            for unknown in (name for name in names if name not in known):
                raise ConfigError(f"{place}: {what} name {unknown!r}, which is none of {', '.join(known)}")

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Name of each sensor."""
        return tuple(name for name, _ in self.sensors)


@dataclass(frozen=True, eq=False)
class Noise:
    """How much a model is off: variances in squared natural units, as ``0.02**2``.

    Parameters
    ----------
    process_variance : (d,) or (d, d), **per second**: a step of dt adds Q dt
    measurement_variance : (m,) of each row, or (n, m) where it changes from sample to sample (of a sample
        whose variance is NaN, zero or negative, the row is not used); rows are independent
    initial_variance : (d,) or (d, d); what the model says without
    walk_variance : (n, d), **per second**, of each sample beside the process variance: for states that change
        faster at times

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

    process_variance: Array
    measurement_variance: Array
    initial_variance: Array | None = None
    walk_variance: Array | None = None

    def __post_init__(self) -> None:
        process = _covariance("process_variance", self.process_variance)
        object.__setattr__(self, "process_variance", process)
        if self.initial_variance is not None:
            initial = _covariance("initial_variance", self.initial_variance, definite=True)
            object.__setattr__(self, "initial_variance", initial)
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
        return Noise(
            self.process_variance,
            r[samples] if r.ndim == 2 else r,
            self.initial_variance,
            None if walk is None else walk[samples],
        )


def _covariance(what: str, given: Any, *, definite: bool = False) -> Array:
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
    """When a measurement or a stamp is not believed.

    Parameters
    ----------
    gate_probability : a sensor's squared innovation under the value that chi-square stays under with this
        probability is believed; 1 believes everything
    reopen_after_s : a sensor that was rejected all this time is believed once.  First the variance of the
        states that it is put down to goes back to the initial one, or to what explains the measurement where
        that is more.  These states are those that it alone observes; without any, those that no sensor used
        before it in the row observes; else all that it does.  A sensor that the model holds takes two seconds
        at least
    max_gap_s : over a longer step nothing is integrated; a log sampled slower than that needs another value

    Raises
    ------
    ConfigError
        where a value is out of its range.

    Examples
    --------
    >>> FilterSettings(gate_probability=99.99)
    Traceback (most recent call last):
    terrain.errors.ConfigError: gate_probability is 99.99, a number over 0 up to 1 is required
    """

    gate_probability: float = 0.9999
    reopen_after_s: float = 1.0
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

UNGATED = FilterSettings(gate_probability=1.0)
"""Every measurement is used."""

MODEL = record(
    {
        **dict.fromkeys(("n_states", "n_rows", "n_sensors", "n_inputs"), int),
        "order": (int, MAX_ROWS),
        "starts": (int, MAX_SENSORS + 1),
        **dict.fromkeys(("is_reference", "is_held"), (bool, MAX_SENSORS)),
        "is_angle_row": (bool, MAX_ROWS),
        **dict.fromkeys(("is_angle_state", "is_position"), (bool, MAX_STATES)),
        "x0": (float, MAX_STATES),
        **dict.fromkeys(("p0", "q"), (float, (MAX_STATES, MAX_STATES))),
        "thresholds": (float, MAX_ROWS + 1),
        **dict.fromkeys(("reopen_after_s", "max_gap_s"), float),
    }
)
"""What is fixed by model, noise and settings: places of the rows, sensor by sensor (``order``), and where each
sensor begins among them; first state and covariance, what is added to it a second, and the largest squared
innovation that is believed, by its number of rows."""

STATE = record(
    {
        **dict.fromkeys(("time_s", "pending_time_s", "reference_age_s", "log_likelihood"), float),
        "x": (float, MAX_STATES),
        "p": (float, (MAX_STATES, MAX_STATES)),
        **dict.fromkeys(("use", "nis_dof"), (np.int8, MAX_SENSORS)),
        **dict.fromkeys(("nis", "rejected_s"), (float, MAX_SENSORS)),
        **dict.fromkeys(("not_advanced", "jumps", "lost"), int),
        **dict.fromkeys(("gated", "not_finite", "numerical"), (int, MAX_SENSORS)),
    }
)
"""All that a filter carries from one sample to the next: a copy is a snapshot.

Stamp of the last sample, that of a jump that is not believed yet, time since the speed over ground was
measured; what became of the sensors of the last sample, for how long each was rejected (-1 for
one that was not), and counts of what was left out."""

_MATRICES = ("f", "fp", "h", "p_before")
_WORK = record(
    {
        **dict.fromkeys(_MATRICES, (float, (MAX_STATES, MAX_STATES))),
        **dict.fromkeys(("f_columns", "h_columns"), (int, (MAX_STATES, MAX_STATES))),
        **dict.fromkeys(("n_f_columns", "n_h_columns", "rows"), (int, MAX_STATES)),
        **dict.fromkeys(
            ("x_next", "x_before", "z_hat", "nu", "dx", "dx_before", "g", "gain", "rounding", "moved"),
            (float, MAX_STATES),
        ),
        "chosen": (bool, MAX_STATES),
    }
)
"""Room to compute in."""

_SKIP, _START, _STEP, _JUMP = range(4)  # what the clock says of a row
_UNSOUND = -1  # a use that is never reported

_kernel = njit(error_model="numpy")


@_kernel
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


@_kernel
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


@_kernel
def _copy(d: int, p: Array, x: Array, p_to: Array, x_to: Array) -> None:
    """Copy a covariance and a state."""
    for i in range(d):
        x_to[i] = x[i]
        for j in range(d):
            p_to[i, j] = p[i, j]


@_kernel
def _find_columns(d: int, m: Array, i: int, columns: Array) -> int:
    """Write the columns in which row i of m is not zero; return how many."""
    n = 0
    for j in range(d):
        if m[i, j] != 0.0:
            columns[i, n] = j
            n += 1
    return n


@_kernel
def _predict(model: Any, state: Any, work: Any, dt: float, params: Array, propagate: Any) -> None:
    """x_next = f(x, dt), and P <- F P F' + Q dt, symmetric to the last bit."""
    d = model.n_states
    p, q, f, fp, columns, n_columns = state.p, model.q, work.f, work.fp, work.f_columns, work.n_f_columns
    f[:d, :d] = 0.0
    propagate(state.x[:d], dt, params, work.x_next[:d], f[:d])
    for i in range(d):
        n_columns[i] = _find_columns(d, f, i, columns)
        for k in range(d):
            fp[i, k] = 0.0
        for c in range(n_columns[i]):
            j = columns[i, c]
            weight = f[i, j]
            for k in range(d):
                fp[i, k] += weight * p[j, k]
    for i in range(d):
        for k in range(i + 1):
            total = q[i, k] * dt
            for c in range(n_columns[k]):
                j = columns[k, c]
                total += fp[i, j] * f[k, j]
            p[i, k] = total
            p[k, i] = total


@_kernel
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


@_kernel
def _step(
    model: Any, state: Any, work: Any, dt: float, walk: Array, inputs: Array, params: Array, propagate: Any
) -> None:
    """Predict; where that leads out of this world, begin anew but for positions that do not."""
    d, x, p = model.n_states, state.x, state.p
    _copy(d, p, x, work.p_before, work.x_before)
    first = params.size - model.n_inputs
    for i in range(model.n_inputs):
        params[first + i] = inputs[i]
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


@_kernel
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


@_kernel
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


@_kernel
def _innovation(model: Any, state: Any, work: Any, i: int) -> tuple[float, float]:
    """Write g = P h' of row i; return its innovation after what was conditioned on before, and h P h'."""
    d, h, columns, g = model.n_states, work.h, work.h_columns, work.g
    nu, spread = work.nu[i], 0.0
    for j in range(d):
        g[j] = 0.0
    for c in range(work.n_h_columns[i]):
        column = columns[i, c]
        weight = h[i, column]
        nu -= weight * work.dx[column]
        for j in range(d):
            g[j] += weight * state.p[column, j]
    for c in range(work.n_h_columns[i]):
        spread += h[i, columns[i, c]] * g[columns[i, c]]
    return nu, spread


@_kernel
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


@_kernel
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
        work.n_h_columns[i] = _find_columns(model.n_states, work.h, i, work.h_columns)
        work.rows[n_rows] = i
        n_rows += 1
    return n_rows


@_kernel
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
    state.log_likelihood += likelihood
    if model.is_reference[k]:
        state.reference_age_s = 0.0


class _Samples(NamedTuple):
    """Stamps and measurements, variances, walks and inputs; the last three for each sample or in one row."""

    time_s: Array
    z: Array
    variance: Array
    walk: Array
    inputs: Array


class _Columns(NamedTuple):
    """What is written of each sample: all but ``taken`` only where they have rows."""

    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: Array
    taken: Array


@_kernel
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
            state.use[k], state.nis[k], state.nis_dof[k] = ABSENT, np.nan, 0
        if kind == _STEP:
            walk = samples.walk[n if samples.walk.shape[0] > 1 else 0]
            inputs = samples.inputs[n if samples.inputs.shape[0] > 1 else 0]
            _step(model, state, work, dt, walk, inputs, params, propagate)
        elif kind == _JUMP:
            _predict_over_gap(model, state, work, dt, params, propagate)
        if columns.taken[n]:
            variance = samples.variance[n if samples.variance.shape[0] > 1 else 0]
            work.h[:m, :d] = 0.0
            observe(x[:d], params, work.z_hat[:m], work.h[:m])
            work.dx[:] = 0.0
            for k in range(n_sensors):
                _condition_on_sensor(model, state, work, samples.z[n], variance, k)
            for i in range(d):
                x[i] += work.dx[i]
                if model.is_angle_state[i]:
                    x[i] = wrapped(x[i])
                for j in range(i):
                    p[j, i] = p[i, j]
        if keep:
            columns.reference_age_s[n] = state.reference_age_s
            for k in range(n_sensors):
                columns.nis[n, k], columns.nis_dof[n, k] = state.nis[k], state.nis_dof[k]
                columns.use[n, k] = state.use[k]
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
    >>> from terrain.estimation.filters.skid import make_skid_filter, skid_noise
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
            CompileResultWAP(f.overloads[tuple(signature.args)])
            for f, signature in ((model.propagate, PROPAGATE), (model.observe, OBSERVE))
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
        time_s : stamp of the sample; the first one starts the clock
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
        n = stamps.size
        samples = [stamps, np.array(z, dtype=np.float64, order="C")]
        shapes: list[tuple[str, list[tuple[int, ...]]]] = [("time_s", [(n,)]), ("z", [(n, m)])]
        for name, array, size in (
            ("measurement_variance", self.noise.measurement_variance, m),
            ("walk_variance", self.noise.walk_variance, d),
            ("inputs", inputs, len(self.model.inputs)),
        ):
            given = np.zeros((1, size)) if array is None else np.atleast_2d(array)
            samples.append(np.array(given, dtype=np.float64, order="C"))
            shapes.append((name, [(n, size), (1, size)]))
        for (name, possible), array in zip(shapes, samples, strict=True):
            if array.shape not in possible:
                raise DataError(
                    f"filter {self.model.name}: {name} has shape {array.shape}, {possible[0]} is needed"
                )
        columns = self._columns(n, keep=keep)
        _take(*self._kernel, _Samples(*samples), columns)
        return columns

    def _columns(self, n: int, *, keep: bool) -> _Columns:
        d, k, n_kept = len(self.model.states), len(self.model.sensors), n if keep else 0
        return _Columns(
            np.empty((n_kept, d)),
            np.empty((n_kept, d, d)),
            np.empty((n_kept, k)),
            np.empty((n_kept, k), np.int8),
            np.empty((n_kept, k), np.int8),
            np.empty(n_kept),
            np.zeros(n, np.bool_),
        )

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        state = self.state[0]
        limit_s = float(self._fixed["max_gap_s"][0])
        follows: int = _follows.py_func(
            time_s, float(state["time_s"]), float(state["pending_time_s"]), limit_s
        )
        return follows

    def known(self, states: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation of those of some states that the filter has, by name."""
        places = {name: self.model.states.index(name) for name in states if name in self.model.states}
        return {name: (float(self.mean[i]), math.sqrt(float(self.cov[i, i]))) for name, i in places.items()}

    def begin_from(self, known: Mapping[str, tuple[float, float]], age_s: float) -> tuple[str, ...]:
        """Start from what was known of some states; return the names of those that are used.

        Parameters
        ----------
        known : mean and standard deviation by name of the state
        age_s : time since then, for which each walks; none is believed less than without it

        Raises
        ------
        DataError
            if a sample was taken already.
        """
        if not math.isnan(self.state["time_s"][0]):
            raise DataError("a filter that runs cannot start from another state")
        used = [name for name in known if name in self.model.states]
        for name in used:
            i = self.model.states.index(name)
            mean, std = known[name]
            variance = std**2 + float(self.noise.process_variance[i, i]) * age_s
            if variance < self.cov[i, i]:
                self.mean[i], self.cov[i, i] = mean, variance
        return tuple(used)

    @property
    def reference_age_s(self) -> float:
        """Time since the speed over ground was last measured; infinite before the first."""
        return float(self.state["reference_age_s"][0])

    @property
    def nis(self) -> dict[str, float]:
        """NIS of each sensor at the last step, a row; NaN where it measured nothing or is not a number."""
        squares, rows = self.state["nis"][0].tolist(), self.state["nis_dof"][0].tolist()
        names = self.model.sensor_names
        return {
            name: square / n if n else math.nan for name, square, n in zip(names, squares, rows, strict=False)
        }

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
    d, m, k = len(model.states), len(model.rows), len(model.sensors)
    for name in ("process_variance", "initial_variance"):
        matrix = getattr(noise, name)
        if matrix is not None and len(matrix) != d:
            raise DataError(f"filter {model.name}: {name} is for {len(matrix)} states, it has {d}")
    if noise.measurement_variance.shape[-1] != m:
        n_rows = noise.measurement_variance.shape[-1]
        raise DataError(f"filter {model.name}: measurement_variance is for {n_rows} rows, it has {m}")
    fixed = filled(
        MODEL,
        n_states=d,
        n_rows=m,
        n_sensors=k,
        n_inputs=len(model.inputs),
        reopen_after_s=settings.reopen_after_s - _SLACK_S,
        max_gap_s=settings.max_gap_s + _SLACK_S,
    )
    one = fixed[0]
    one["order"][:m] = [model.rows.index(row) for _, rows in model.sensors for row in rows]
    one["starts"][: k + 1] = np.cumsum([0, *(len(rows) for _, rows in model.sensors)])
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
    one["thresholds"] = np.inf
    widest = max(len(rows) for _, rows in model.sensors)
    one["thresholds"][1 : widest + 1] = chdtri(np.arange(1.0, widest + 1), 1 - settings.gate_probability)
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


def log_likelihood(
    model: FilterModel, noise: Noise, time_s: Array, z: Array, settings: FilterSettings = UNGATED
) -> float:
    """Return the log likelihood of a log without keeping its track; everything is believed by default."""
    session = Filter(model, noise, settings)
    session.run(time_s, z, keep=False)
    return float(session.state["log_likelihood"][0])
