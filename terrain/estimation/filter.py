"""One extended Kalman step for every filter, in a batch or sample by sample.

State x (d,) with covariance P, measurement z (m,) with independent rows of variance R, functions f and h::

    predict       x <- f(x, dt)              P <- F P F' + Q dt (+ integrals)   F = df/dx
    condition on  nu = z - h(x), s = H P H' + R, K = P H' / s                   H = dh/dx
                  x <- x + K nu              P <- P - K H P - P H' K' + K s K'  (Joseph form)

h and H are evaluated once a step, at the predicted state, and the rows conditioned on one by one: the same
answer as all at once, in O(m d^2) and without inverting a matrix.

Noise comes in all through a step, and what moves a rate early moves its integral by the end: of white noise of variance
q a second on a rate, the step leaves ``q dt`` there, ``q dt^2 / 2`` in common with the integral, and ``q dt^3 / 3`` in
that.  With ``q dt`` alone the integral follows the start of a turn half a step late.

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
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter
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
    """What a filter estimates, from what, and how much either is off.

    Raises
    ------
    ConfigError
        where a name has no unit, is given twice or refers to nothing, an array does not fit or is no variance, or a
        function is none of numba.
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
    #: variances in squared natural units, as ``0.02**2``: (d,) or (d, d) **per second**, a step of dt adds
    #: :func:`process_noise`; (m,) of each row, rows are independent; (d,) or (d, d) of the state where nothing is known
    process_variance: Array
    measurement_variance: Array
    initial_variance: Array
    initial_mean: Any = ()  #: (d,) zeros without
    #: names of what is known of each step beside the state; 0 where it is not given
    inputs: tuple[str, ...] = ()
    references: tuple[str, ...] = ()  #: sensors of the speed over ground
    #: sensors that are not reopened before two seconds: those that fail, rather than show the ground's doing
    held: tuple[str, ...] = ()
    #: sensors whose rejection is put down to some states, each with one of them; of others by the rule of the settings
    jumps: tuple[tuple[str, str], ...] = ()
    #: states that a gap in the data leaves where they were, with a covariance that grew
    positions: tuple[str, ...] = ()
    #: states that integrate another one, each with it: they share its noise
    integrals: tuple[tuple[str, str], ...] = ()
    angle_states: tuple[str, ...] = ()  #: states that are wrapped to (-pi, pi], and rows whose innovation is
    angle_rows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        place, d, m = f"filter {self.name}", len(self.states), len(self.rows)
        for name in (*self.states, *self.rows):
            try:
                unit_of(name)
            except LogError as error:
                raise ConfigError(f"{place}: {str(error).replace('channel', 'state or row')}") from None
        for what, names in (("states", self.states), ("rows", self.rows), ("sensors", self.sensor_names)):
            if len(set(names)) < len(names) or len(names) > MOST:
                raise ConfigError(f"{place}: {what} {list(names)} have one twice, or are more than {MOST}")
        grouped = list(chain.from_iterable(map(itemgetter(1), self.sensors)))
        if sorted(grouped) != sorted(self.rows):
            raise ConfigError(f"{place}: its sensors must hold every row once; they hold {grouped}")
        for what, known in (
            *dict.fromkeys(("references", "held"), self.sensor_names).items(),
            *dict.fromkeys(("positions", "integrals", "angle_states"), self.states).items(),
            ("angle_rows", self.rows),
            ("jumps", (*self.sensor_names, *self.states)),
        ):
            if unknown := set(np.ravel(getattr(self, what)).tolist()) - set(known):
                raise ConfigError(f"{place}: {what} name {unknown}, none of {', '.join(known)}")
        if not len(self.initial_mean):
            object.__setattr__(self, "initial_mean", np.zeros(d))
        for what, shape in (
            ("params", None),
            ("initial_mean", (d,)),
            ("measurement_variance", (m,)),
            ("process_variance", (d, d)),
            ("initial_variance", (d, d)),
        ):
            array = np.asarray(getattr(self, what), dtype=np.float64)
            if shape == (d, d) and array.ndim == 1:
                array = np.diag(array)
            if array.shape != (shape or array.shape) or not np.isfinite(array).all():
                raise ConfigError(f"{place}: {what} has shape {array.shape}, finite {shape} is needed")
            if shape == (d, d):
                array, scale = (array + array.T) / 2, np.abs(array).max()
                least = np.linalg.eigvalsh(array)[0]
                if least < -1e-12 * scale or (least <= 0 and what == "initial_variance"):
                    raise ConfigError(
                        f"{place}: {what} is no covariance: its least eigenvalue is {least:.3g}"
                    )
            object.__setattr__(self, what, read_only(array))
        if not (self.measurement_variance > 0).all():
            raise ConfigError(f"{place}: measurement_variance must be above zero")
        for name, signature in _SIGNATURES.items():
            function = getattr(self, name)
            if tuple(signature.args) not in getattr(function, "signatures", ()):
                try:
                    function.compile(signature)
                except (AttributeError, RuntimeError, TypeError, NumbaError):
                    raise ConfigError(f"{place}: {name} must be @njit, and take {signature}") from None

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Name of each sensor."""
        return tuple(map(itemgetter(0), self.sensors))


class FilterSettings(NamedTuple):
    """When a measurement or a stamp is not believed."""

    #: a sensor's squared innovation under the value that chi-square stays under with this probability is believed; 1
    #: believes everything
    gate_probability: float = 0.9999
    #: a sensor that was rejected all this time is believed once.  First the variance of the states that it is put
    #: down to goes back to the initial one, or to what explains the measurement where that is more.  These states are
    #: those that the model has for it (jumps), or it alone observes; without any, those that no sensor used before it
    #: in the row observes; else all that it does.  A sensor that the model holds takes two seconds at least
    reopen_after_s: float = 1.0
    #: over a longer step nothing is integrated; a log sampled slower than that needs another value
    max_gap_s: float = 1.0


DEFAULT_SETTINGS = FilterSettings()

#: What is fixed by model and settings: places of the rows, sensor by sensor (``order``), and where each sensor
#: begins among them; first state and covariance, what is added to it a second, and the largest squared innovation
#: that is believed, by its number of rows.
MODEL = record(
    {
        **dict.fromkeys(("n_states", "n_rows", "n_sensors", "n_inputs"), int),
        **dict.fromkeys(("order", "starts"), (int, MOST + 1)),
        **dict.fromkeys(
            ("is_reference", "is_held", "is_angle_row", "is_angle_state", "is_position"), (bool, MOST)
        ),
        "rate": (int, MOST),  # of a state that integrates it; -1 of others
        "jumps": (bool, (MOST, MOST)),  # whether the rejection of a sensor is put down to a state
        "x0": (float, MOST),
        **dict.fromkeys(("p0", "q"), (float, (MOST, MOST))),
        "thresholds": (float, MOST + 1),
        **dict.fromkeys(("reopen_after_s", "max_gap_s"), float),
    }
)

#: All that a filter carries from one sample to the next: a copy is a snapshot.  Stamp of the last sample, that of a
#: jump that is not believed yet, time since the speed over ground was measured; what became of the sensors of the
#: last sample and how likely it was, for how long each was rejected (-1 for one that was not), and counts of what was
#: left out.
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

#: Room to compute in.
_WORK = record(
    {
        **dict.fromkeys(("f", "fp", "h", "p_other"), (float, (MOST, MOST))),
        **dict.fromkeys(("x_next", "z_hat", "nu", "dx", "dx_before"), (float, MOST)),
        **dict.fromkeys(("g", "gain", "rounding", "moved"), (float, MOST)),
        "rows": (int, MOST),
        "chosen": (bool, MOST),
    }
)

_NOT_ADVANCED, _JUMPED, _START, _STEP, _GAP = range(5)  # what a stamp is; the first two are not taken

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
def _read_stamp(time_s: float, last_s: float, pending_s: float, max_gap_s: float) -> int:
    """Return what a stamp is: a jump is believed where the stamp follows one that jumped before."""
    step_s = time_s - last_s
    if not math.isfinite(time_s):
        return _NOT_ADVANCED
    if math.isnan(step_s):
        return _START
    if abs(step_s) <= max_gap_s:
        return _STEP if step_s > 0.0 else _NOT_ADVANCED
    return _GAP if 0.0 < time_s - pending_s <= max_gap_s else _JUMPED


@_inner
def _copy(d: int, p: Array, x: Array, p_to: Array, x_to: Array) -> None:
    """Copy a covariance and a state."""
    for i in range(d):
        x_to[i] = x[i]
        for j in range(d):
            p_to[i, j] = p[i, j]


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
def _noise(model: Any, walk: Array, i: int, k: int, dt: float) -> float:
    """Return an entry of :func:`process_noise`."""
    per_i, per_k = model.rate[i], model.rate[k]
    noise = model.q[i, k] + (walk[i] if i == k else 0.0)
    if per_i >= 0:
        noise += dt / 2.0 * (model.q[per_i, k] + (walk[k] if per_i == k else 0.0))
    if per_k >= 0:
        noise += dt / 2.0 * (model.q[i, per_k] + (walk[i] if per_k == i else 0.0))
    if per_i >= 0 and per_k >= 0:
        noise += dt * dt / 3.0 * (model.q[per_i, per_k] + (walk[per_i] if i == k else 0.0))
    return float(noise * dt)


@_inner
def _predict(
    model: Any, state: Any, work: Any, is_gap: bool, dt: float, walk: Array, params: Array, propagate: Any
) -> None:
    """Predict x <- f(x, dt), and P <- F P F' + :func:`process_noise`, symmetric to the last bit.

    Where that leads out of this world, begin anew but for positions that do not.  Over a gap all covariances are
    reset but those of the positions, which grow by what the speeds may have been, and the means stay.
    """
    d, x, p, f, fp, p_next = model.n_states, state.x, state.p, work.f, work.fp, work.p_other
    if is_gap:
        for i in range(d):
            work.chosen[i] = not model.is_position[i]
        _reset_covariance(model, state, work.chosen)
    span_s = min(abs(dt), LONGEST_GAP_S)
    f[:d, :d] = 0.0
    fp[:d, :d] = 0.0
    propagate(x[:d], span_s, params, work.x_next[:d], f[:d])
    for i in range(d):
        for j in range(d):
            if f[i, j] != 0.0:
                for k in range(d):
                    fp[i, k] += f[i, j] * p[j, k]
    n_bad = 0
    for i in range(d):
        for k in range(i + 1):
            total = _noise(model, walk, i, k, span_s)
            for j in range(d):
                if f[k, j] != 0.0:
                    total += fp[i, j] * f[k, j]
            p_next[i, k] = total
            p_next[k, i] = total
        n_bad += not ((abs(work.x_next[i]) <= LARGEST) & (p_next[i, i] > 0.0) & (p_next[i, i] <= WIDEST))
    if is_gap:
        for i in range(d):
            for j in range(d):
                if model.is_position[i] and model.is_position[j]:
                    p[i, j] = p_next[i, j]
    elif n_bad == 0:
        _copy(d, p_next, work.x_next, p, x)
    else:
        for i in range(d):
            work.chosen[i] = not model.is_position[i] or p[i, i] > LARGEST**2
            if not model.is_position[i]:
                x[i] = model.x0[i]
        _reset_covariance(model, state, work.chosen)
        state.lost += 1
    # of a clock that was set back the age is unknown
    state.reference_age_s = state.reference_age_s + dt if dt > 0.0 else np.inf
    for k in range(model.n_sensors):
        if is_gap:
            state.rejected_s[k] = -1.0
        elif state.rejected_s[k] >= 0.0:
            state.rejected_s[k] += dt


def process_noise(model: FilterModel, dt_s: float, walk: Array | float = 0.0) -> Array:
    """Return the covariance (d, d) that a step adds, with what the states walk (d,) beside, in variance per second."""
    d = len(model.states)
    per_s = model.process_variance + np.diag(np.broadcast_to(walk, d))
    moved = np.zeros((d, d))  # by what a rate was moved by within the step
    for state, rate in model.integrals:
        moved[model.states.index(state), model.states.index(rate)] = dt_s
    return np.asarray(per_s + (moved @ per_s + per_s @ moved.T) / 2.0 + moved @ per_s @ moved.T / 3.0) * dt_s


@_inner
def _choose_states(model: Any, state: Any, work: Any, k: int) -> None:
    """Mark the states that the rejection of sensor k is put down to.

    Those that the model has for it; without any, those that it alone observes; without any, those that no sensor used
    before it in this row observes; without any, all that it observes.
    """
    h, order, starts, chosen = work.h, model.order, model.starts, work.chosen
    chosen[:] = model.jumps[k]
    if chosen.any():
        return
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
        k, rest = gain[i], rounding[i]
        for j in range(d):
            p[i, j] = (p[i, j] - k * g[j]) + rest * gain[j]
    return True


@_inner
def _condition_on_sensor(model: Any, state: Any, work: Any, z: Array, variance: Array, k: int) -> None:
    """Condition on all rows of a sensor, or on none: gate it, or reopen it once it was rejected for long."""
    d, p, dx, rows, n_rows = model.n_states, state.p, work.dx, work.rows, 0
    for c in range(model.starts[k], model.starts[k + 1]):
        i = model.order[c]
        if np.isnan(z[i]):
            continue
        if not (abs(z[i]) <= LARGEST and variance[i] > 0.0 and variance[i] < np.inf):
            state.not_finite[k] += 1
            continue
        nu = z[i] - work.z_hat[i]
        work.nu[i] = wrapped(nu) if model.is_angle_row[i] else nu
        rows[n_rows] = i
        n_rows += 1
    if n_rows == 0:
        return
    if n_rows > 1:  # one row alone is judged before anything changes
        _copy(d, p, dx, work.p_other, work.dx_before)
    use, threshold, square, likelihood, is_sound = USED, model.thresholds[n_rows], np.nan, 0.0, True
    for attempt in range(2):
        total, likelihood, is_sound, is_definite = 0.0, 0.0, True, True
        for c in range(n_rows):
            r = variance[rows[c]]
            nu, spread = _innovation(model, state, work, rows[c])
            s = spread + r
            is_definite &= s > 0.5 * r
            total += nu * nu / s
            likelihood -= 0.5 * (math.log(2.0 * math.pi * s) + nu * nu / s)
            if is_definite and (c < n_rows - 1 or total <= threshold):
                is_sound &= _condition_on(model, state, work, nu, spread, r)
        if attempt == 0:
            square = total
        is_sound &= is_definite
        if total <= threshold and is_sound:
            break
        if n_rows > 1 or attempt == 1:
            _copy(d, work.p_other, work.dx_before, p, dx)
        if not is_definite:  # rounding has made P no covariance: go on without its correlations
            work.chosen[:] = True
            _reset_covariance(model, state, work.chosen)
        if total <= threshold or attempt == 1 or not is_definite:
            is_sound = False
            break
        state.rejected_s[k] = max(state.rejected_s[k], 0.0)
        after_s = max(model.reopen_after_s, HELD_S) if model.is_held[k] else model.reopen_after_s
        if state.rejected_s[k] < after_s:
            use, is_sound = GATED, True
            break
        use, threshold = REOPENED, np.inf
        _copy(d, p, dx, work.p_other, work.dx_before)
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
    if not is_sound:
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
    time_s: Array  #: stamps, and measurements, variances, walks and inputs of each
    z: Array
    variance: Array
    walk: Array
    inputs: Array


class _Columns(NamedTuple):
    mean: Array  #: what is written of each sample: the first five only where they have rows
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
    for n in range(samples.time_s.size):
        time_s, dt = samples.time_s[n], samples.time_s[n] - state.time_s
        kind = _read_stamp(time_s, state.time_s, state.pending_time_s, model.max_gap_s)
        columns.taken[n] = kind >= _START
        for k in range(n_sensors):
            state.use[k], state.nis[k], state.nis_dof[k], state.likelihood[k] = ABSENT, np.nan, 0, 0.0
        if kind == _NOT_ADVANCED:
            state.not_advanced += 1
        elif kind == _JUMPED:
            state.jumps += 1
            state.pending_time_s = time_s
        else:
            state.time_s, state.pending_time_s = time_s, np.nan
            for i in range(model.n_inputs):
                params[params.size - model.n_inputs + i] = samples.inputs[n, i]
            if kind != _START:
                _predict(model, state, work, kind == _GAP, dt, samples.walk[n], params, propagate)
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
        if columns.mean.shape[0] > 0:
            columns.reference_age_s[n] = state.reference_age_s
            for k in range(n_sensors):
                columns.use[n, k], columns.nis_dof[n, k] = state.use[k], state.nis_dof[k]
            for i in range(d):
                columns.mean[n, i] = x[i]
                for j in range(d):
                    columns.cov[n, i, j] = p[i, j]


class Filter:
    """A filter in use: a model, and the state that each sample moves.

    Parameters
    ----------
    model, settings : as of :func:`run_filter`

    Attributes
    ----------
    state : (1,) record :data:`STATE`, all that is remembered: copy it for a snapshot, and assign that to go
        back
    mean, cov : (d,) and (d, d) of the state, views that the next step writes over
    use : (k,) what became of each sensor at the last step

    Examples
    --------
    >>> from terrain.estimation.models.swerve import make_filter
    >>> from terrain.robots import load_robot
    >>> filter = Filter(make_filter("encoder12", load_robot("agrimaro")))
    >>> wheels = np.array([8.0, 8.0, 8.0, *np.full(len(filter.model.rows) - 3, np.nan)])
    >>> filter.step(0.0, wheels), filter.step(0.0, np.full(len(filter.model.rows), np.nan))
    (True, False)
    >>> filter.model.rows[0], round(float(filter.mean[filter.model.states.index("speed_x_mps")]), 2)
    ('wheel_1_radps', 1.6)
    """

    def __init__(self, model: FilterModel, settings: FilterSettings = DEFAULT_SETTINGS) -> None:
        sizes = d, m, k, n_inputs = tuple(map(len, (model.states, model.rows, model.sensors, model.inputs)))
        grouped = list(map(itemgetter(1), model.sensors))
        n_rows = list(map(len, grouped))  # of each sensor
        fixed = filled(
            MODEL,
            **dict(zip(("n_states", "n_rows", "n_sensors", "n_inputs"), sizes, strict=True)),
            reopen_after_s=settings.reopen_after_s - _SLACK_S,
            max_gap_s=settings.max_gap_s + _SLACK_S,
            thresholds=np.inf,
        )
        one = fixed[0]
        one["order"][:m] = list(map(model.rows.index, chain.from_iterable(grouped)))
        one["starts"][: k + 1] = np.cumsum([0, *n_rows])
        for name, names, chosen in (
            ("is_reference", model.sensor_names, model.references),
            ("is_held", model.sensor_names, model.held),
            ("is_angle_row", model.rows, model.angle_rows),
            ("is_angle_state", model.states, model.angle_states),
            ("is_position", model.states, model.positions),
        ):
            one[name][: len(names)] = np.isin(names, chosen)
        one["rate"] = -1
        for name, state in model.jumps:
            one["jumps"][model.sensor_names.index(name), model.states.index(state)] = True
        for name, rate in model.integrals:
            one["rate"][model.states.index(name)] = model.states.index(rate)
        one["x0"][:d] = model.initial_mean
        one["p0"][:d, :d], one["q"][:d, :d] = model.initial_variance, model.process_variance
        dof = np.arange(1.0, 1 + max(n_rows))
        one["thresholds"][1 : 1 + dof.size] = chdtri(dof, 1 - settings.gate_probability)
        self.model, self._max_gap_s = model, settings.max_gap_s + _SLACK_S
        self.state = filled(
            STATE, nis=np.nan, time_s=np.nan, pending_time_s=np.nan, reference_age_s=np.inf, rejected_s=-1.0
        )
        self.mean, self.cov = self.state["x"][0, :d], self.state["p"][0, :d, :d]
        self.use = self.state["use"][0, :k]
        self.mean[:], self.cov[:] = model.initial_mean, model.initial_variance
        params = np.append(model.params, np.zeros(n_inputs))
        self._kernel: tuple[Any, ...] = fixed, self.state, filled(_WORK), params
        for name, signature in _SIGNATURES.items():  # compiled with it: finding them costs more than a step
            function = getattr(model, name).overloads[tuple(signature.args)]
            self._kernel += (CompileResultWAP(function),)
        self._sample = _Samples(np.empty(1), *map(np.zeros, ((1, m), (1, m), (1, d), (1, n_inputs))))
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
        variance : (m,) in place of that of the model
        walk : (d,) variance per second up to the sample, beside the process variance
        inputs : (k,) of the step up to the sample
        """
        sample = self._sample
        sample.time_s[0], sample.z[0] = time_s, z
        sample.variance[0] = self.model.measurement_variance if variance is None else variance
        sample.walk[0] = 0.0 if walk is None else walk
        sample.inputs[0] = 0.0 if inputs is None else inputs
        if self._compiled is None:
            _take(*self._kernel, sample, self._nothing)
            (compiled,) = _take.overloads.values()  # its types are found once: that takes longer than a step
            self._compiled = compiled.entry_point
        else:
            self._compiled(*self._kernel, sample, self._nothing)
        return bool(self._nothing.taken[0])

    def run(
        self,
        time_s: Array,
        z: Array,
        variance: Array | None = None,
        walk: Array | None = None,
        inputs: Array | None = None,
        *,
        keep: bool = True,
    ) -> _Columns:
        """Take in all samples of a log, each as of :meth:`step`; return what is known at each, empty unless kept."""
        d, m, stamps = len(self.model.states), len(self.model.rows), np.array(time_s, dtype=np.float64)
        n, samples = stamps.size, [stamps]
        variance = self.model.measurement_variance if variance is None else variance
        for name, array, size in (
            ("z", z, m),
            ("variance", variance, m),
            ("walk", walk, d),
            ("inputs", inputs, len(self.model.inputs)),
        ):
            given = np.zeros((1, size)) if array is None else np.atleast_2d(array)
            if given.shape != (n, size) and (name == "z" or given.shape != (1, size)):
                raise DataError(
                    f"filter {self.model.name}: {name} has shape {given.shape}, {(n, size)} is needed"
                )
            samples.append(np.array(np.broadcast_to(given, (n, size)), dtype=np.float64, order="C"))
        columns = self._columns(n, keep=keep)
        _take(*self._kernel, _Samples(*samples), columns)
        return columns

    def _columns(self, n: int, *, keep: bool) -> _Columns:
        d, k, n_kept = self.mean.size, self.use.size, n if keep else 0
        nis_dof, use = np.empty((2, n_kept, k), np.int8)
        nis, likelihood = np.empty((2, n, k))
        mean, cov, age_s = np.empty((n_kept, d)), np.empty((n_kept, d, d)), np.empty(n_kept)
        return _Columns(mean, cov, nis_dof, use, age_s, nis, likelihood, np.zeros(n, np.bool_))

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        last_s, pending_s = (float(self.state[name][0]) for name in ("time_s", "pending_time_s"))
        if _read_stamp.py_func(time_s, last_s, pending_s, self._max_gap_s) < _START:
            return 0
        return -1 if time_s < last_s else 1

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
                variance = std**2 + float(self.model.process_variance[i, i]) * age_s
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
        counts = Counter(
            {"time did not advance": int(state["not_advanced"]), "clock jump": int(state["jumps"])}
        )
        counts["state numerical"] = int(state["lost"])
        for k, sensor in enumerate(self.model.sensor_names):
            for name in ("gated", "not_finite", "numerical"):
                counts[f"{sensor} {name.replace('_', ' ')}"] = int(state[name][k])
        return dict(+counts)


def run_filter(
    model: FilterModel,
    time_s: Array,
    z: Array,
    settings: FilterSettings = DEFAULT_SETTINGS,
    variance: Array | None = None,
    walk: Array | None = None,
    inputs: Array | None = None,
) -> StateTrack:
    """Filter a whole log.

    Parameters
    ----------
    model : what is estimated, from what
    time_s : (n,) stamps, at any spacing
    z : (n, m) measurements, NaN where there is none
    settings : gates and gaps
    variance : (n, m) where it changes from sample to sample; of a sample whose variance is NaN, zero or negative, the
        row is not used
    walk : (n, d) variance per second up to each sample, beside the process variance
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
        where the shapes do not fit each other or the model.

    Notes
    -----
    After a jump, means are kept and all covariances but those of the positions go back to the initial one, or
    stay where they were when wider; positions are as uncertain as the speeds that this allows make them over
    the gap.  The means are kept because a logger pauses more often than a drive ends, and because what a gap
    does not change, as a gyro's bias, is best known from before; the covariance makes either harmless.
    """
    session = Filter(model, settings)
    stamps = np.array(time_s, dtype=np.float64)
    columns = session.run(stamps, z, variance, walk, inputs)
    reached = np.maximum.accumulate(np.where(columns.taken, stamps, -np.inf))
    shown = columns.taken & (stamps > np.append(-np.inf, reached[:-1])[: stamps.size])
    dropped = session.dropped
    if not shown.all():
        if set_back := int((columns.taken & ~shown).sum()):
            dropped["clock set back"] = set_back
        stamps, columns = stamps[shown], _Columns(*(column[shown] for column in columns))
    for array in (stamps, *columns):
        array.flags.writeable = False
    mean, cov, nis_dof, use, age_s, nis, *_ = columns
    log_likelihood = float(session.state["log_likelihood"][0])
    return StateTrack(
        stamps,
        mean,
        cov,
        model.states,
        nis,
        nis_dof,
        use,
        model.sensor_names,
        age_s,
        log_likelihood,
        dropped,
    )
