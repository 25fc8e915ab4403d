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
that a filter that went wrong finds back.  A leap of the clock is believed when the next stamp follows it, and
is not integrated over.  Nothing that comes in makes what comes out infinite or NaN.

Source: the form of the step follows the textbook of Sarkka, Bayesian Filtering and Smoothing (2013), 5.2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numba.core.types.function_type import CompileResultWAP
from scipy.special import chdtri

from terrain.errors import ConfigError, DataError, LogError
from terrain.estimation.kernel import (
    AGE,
    LIKELIHOOD,
    OBSERVE,
    PENDING,
    PER_ROW,
    PER_SENSOR,
    PROPAGATE,
    TIME,
    run,
)
from terrain.logs.schema import unit_of
from terrain.records import Array, StateTrack, read_only

GATE_PROBABILITY = 1.0 - 1e-6
"""Five standard deviations: a wheel that starts to slip is a surprise of four, and no fault."""

REOPEN_AFTER_S = 0.2
"""Spikes last a sample or two; what disagrees for longer is the ground's doing, a brake or a bump."""

_SLACK_S = 1e-9  # what sums of steps may be off by


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
        Jacobian (d, d) that are not zero: F comes as zeros, and rows that stay short cost less
    observe : ``observe(x, params, z_hat, H)`` writes the measurement expected (m,), and the entries of H
        (m, d) that are not zero.  Both are compiled with signatures of :mod:`terrain.estimation.kernel`, as
        ``@njit(PROPAGATE, cache=True)``: with an explicit one numba finds them again on disk
    params : what the two functions need of the robot
    initial_std : (d,) how little is known of each state where nothing is known
    initial_mean : (d,) zeros without
    references : sensors of the speed over ground
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
    references: tuple[str, ...] = ()
    positions: tuple[str, ...] = ()
    angle_states: tuple[str, ...] = ()
    angle_rows: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        place = f"filter {self.name}"
        if not len(self.initial_mean):
            object.__setattr__(self, "initial_mean", np.zeros(len(self.states)))
        for name in ("params", "initial_std", "initial_mean"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("initial_std", "initial_mean"):
            shape = getattr(self, name).shape
            if shape != (len(self.states),):
                raise ConfigError(f"{place}: {name} has shape {shape}, {(len(self.states),)} is needed")
        if not (np.isfinite(self.initial_std).all() and (self.initial_std > 0).all()):
            raise ConfigError(
                f"{place}: initial_std {self.initial_std.tolist()} must be above zero and finite"
            )
        for name in (*self.states, *self.rows):
            try:
                unit_of(name)
            except LogError as error:
                raise ConfigError(f"{place}: {str(error).replace('channel', 'state or row')}") from None
        grouped = [row for _, rows in self.sensors for row in rows]
        for what, names in (("states", self.states), ("rows", self.rows), ("sensors", self.sensor_names)):
            if len(set(names)) < len(names):
                raise ConfigError(f"{place}: {what} {list(names)} name one of them twice")
        if sorted(grouped) != sorted(self.rows):
            raise ConfigError(f"{place}: its sensors must hold every row once; they hold {grouped}")
        for what, names, known in (
            ("references", self.references, self.sensor_names),
            ("positions", self.positions, self.states),
            ("angle_states", self.angle_states, self.states),
            ("angle_rows", self.angle_rows, self.rows),
        ):
            for unknown in (name for name in names if name not in known):
                raise ConfigError(f"{place}: {what} name {unknown!r}, which is none of {', '.join(known)}")
        for what, signature in (("propagate", PROPAGATE), ("observe", OBSERVE)):
            if tuple(signature.args) not in getattr(getattr(self, what), "signatures", ()):
                raise ConfigError(f"{place}: {what} must be compiled as @njit({what.upper()}, cache=True)")

    @property
    def sensor_names(self) -> tuple[str, ...]:
        """Name of each sensor."""
        return tuple(name for name, _ in self.sensors)

    @cached_property
    def _constants(self) -> tuple[Any, ...]:
        """What the kernel needs of the model, in its order."""
        order = [self.rows.index(row) for _, rows in self.sensors for row in rows]
        starts = np.cumsum([0, *(len(rows) for _, rows in self.sensors)])
        marks = (
            (self.sensor_names, self.references),
            (self.rows, self.angle_rows),
            (self.states, self.angle_states),
            (self.states, self.positions),
        )
        return (
            self.propagate,
            self.observe,
            self.params.copy(),
            np.array(order, dtype=np.int64),
            starts.astype(np.int64),
            *(np.array([name in chosen for name in names], dtype=np.bool_) for names, chosen in marks),
            self.initial_mean.copy(),
        )


@dataclass(frozen=True, eq=False)
class Noise:
    """How much a model is off: variances in squared natural units, as ``0.02**2``.

    Parameters
    ----------
    process_variance : (d,) or (d, d), **per second**: a step of dt adds Q dt
    measurement_variance : (m,) of each row, or (n, m) where it changes from sample to sample (of a sample
        whose variance is NaN, zero or negative, the row is not used); rows are independent
    initial_variance : (d,) or (d, d); what the model says without

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

    def __post_init__(self) -> None:
        process = _covariance("process_variance", self.process_variance)
        object.__setattr__(self, "process_variance", process)
        if self.initial_variance is not None:
            initial = _covariance("initial_variance", self.initial_variance, definite=True)
            object.__setattr__(self, "initial_variance", initial)
        r = read_only(self.measurement_variance)
        object.__setattr__(self, "measurement_variance", r)
        if r.ndim not in (1, 2):
            raise ConfigError(f"measurement_variance has shape {r.shape}, (m,) or (n, m) is needed")
        if r.ndim == 2 and r.shape[0] == r.shape[1] > 1 and (r == r.T).all() and np.ptp(r) > 0:
            raise ConfigError("measurement_variance is a matrix: rows are taken as independent, give (m,)")
        if r.ndim == 1 and not ((r > 0) & np.isfinite(r)).all():
            raise ConfigError(f"measurement_variance {r.tolist()} must be above zero and finite")


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
        states to blame goes back to the initial one, or to what explains the measurement where that is more.
        To blame are those that it alone observes; without any, those that no sensor used before it in the
        row observes; else all that it does
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


class FilterState(NamedTuple):
    """All that a filter carries from one sample to the next; :func:`initial_state` makes the first.

    ``mean`` to ``log_likelihood`` are what :class:`~terrain.records.StateTrack` holds of one instant; the
    rest is the filter's own.  ``time_s`` is NaN before the first sample.
    """

    time_s: float
    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: float
    log_likelihood: float
    pending_time_s: float
    rejected_s: Array
    counts: Array
    sensors: tuple[str, ...]

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not taken so far, as counts by kind."""
        return _dropped(self.sensors, self.counts)


def initial_state(model: FilterModel, noise: Noise) -> FilterState:
    """Return what a filter knows before the first sample."""
    k = len(model.sensors)
    return FilterState(
        math.nan,
        model.initial_mean,
        _initial_variance(model, noise),
        np.full(k, np.nan),
        np.zeros(k, np.int8),
        np.zeros(k, np.int8),
        math.inf,
        0.0,
        math.nan,
        np.full(k, -1.0),
        np.zeros(len(PER_ROW) + k * len(PER_SENSOR), np.int64),
        model.sensor_names,
    )


def filter_step(
    model: FilterModel,
    noise: Noise,
    state: FilterState,
    time_s: float,
    z: Array,
    settings: FilterSettings = FilterSettings(),
    measurement_variance: Array | None = None,
) -> FilterState:
    """Return the state after one sample; sample by sample a log gives what it gives at once, bit for bit.

    Parameters
    ----------
    model, noise, settings : as of :func:`run_filter`
    state : of the sample before, or :func:`initial_state`; it is not changed
    time_s : stamp of the sample; the first one starts the clock
    z : (m,) measurements, NaN where there is none
    measurement_variance : (m,) of this sample; that of ``noise`` without

    Returns
    -------
    FilterState
        with ``use`` all :data:`~terrain.records.ABSENT` and the state as it was, where the stamp did not
        advance, or leapt.

    Raises
    ------
    DataError
        where z or the variance has the wrong length.
    """
    r = noise.measurement_variance if measurement_variance is None else np.asarray(measurement_variance)
    memory = _memory(state)
    columns = _feed(
        model, noise, settings, np.array([time_s], dtype=np.float64), np.asarray(z)[None], r, memory
    )
    for array in (*memory, *columns):
        array.flags.writeable = False
    seen_s, pending_s, age_s, likelihood = memory.clock.tolist()
    return FilterState(
        seen_s,
        memory.x,
        memory.p,
        columns.nis[0],
        columns.nis_dof[0],
        columns.use[0],
        age_s,
        likelihood,
        pending_s,
        memory.rejected_s,
        memory.counts,
        state.sensors,
    )


class ResidentFilter:
    """A filter that keeps its memory, for loops that cannot wait: the numbers of :func:`filter_step`.

    Parameters
    ----------
    model, noise, settings : as of :func:`run_filter`; the measurement variance is (m,)

    Raises
    ------
    DataError
        where the noise does not fit the model, or changes from sample to sample.

    Notes
    -----
    ``mean`` and ``cov`` are the memory itself, which the next step writes over.  Most of what
    :func:`filter_step` takes goes into copies and into finding the model's compiled functions anew.
    """

    def __init__(self, model: FilterModel, noise: Noise, settings: FilterSettings = FilterSettings()) -> None:
        if noise.measurement_variance.ndim != 1:
            raise DataError(f"filter {model.name}: measurement_variance must be (m,) for a step at a time")
        p0, q = _matrices(model, noise)
        d, k, m = len(model.states), len(model.sensors), len(model.rows)
        self._memory = _memory(initial_state(model, noise))
        self._columns = _Columns(
            np.empty((1, d)),
            np.empty((1, d, d)),
            np.empty((1, k)),
            np.zeros((1, k), np.int8),
            np.zeros((1, k), np.int8),
            np.empty(1),
            np.zeros(1, np.bool_),
        )
        self._sensors, self._max_gap_s = model.sensor_names, settings.max_gap_s + _SLACK_S
        self._noise_variance, self._variance = noise.measurement_variance, np.empty((1, m))
        self._stamp, self._z = np.empty(1), np.empty((1, m))
        # by their addresses, found once: a compiled function itself is looked up at each call, for 40 us
        functions = zip((model.propagate, model.observe), (PROPAGATE, OBSERVE), strict=True)
        self._arguments = (
            *(CompileResultWAP(f.overloads[tuple(signature.args)]) for f, signature in functions),
            *model._constants[2:],
            *(p0, q, _thresholds(model, settings), self._variance),
            *(settings.reopen_after_s - _SLACK_S, self._max_gap_s),
            *(self._stamp, self._z, *self._memory, *self._columns),
        )
        self.mean, self.cov, self.use = self._memory.x, self._memory.p, self._columns.use[0]

    def step(self, time_s: float, z: Array, measurement_variance: Array | None = None) -> bool:
        """Take in one sample; return False where its stamp did not advance, or leapt."""
        self._stamp[0] = time_s
        self._z[0] = z
        self._variance[0] = self._noise_variance if measurement_variance is None else measurement_variance
        run(*self._arguments)
        return bool(self._columns.taken[0])

    def follows(self, time_s: float) -> int:
        """Return what a stamp would be: 1 taken, -1 taken as that of a clock set back, 0 not taken."""
        seen_s, pending_s = float(self._memory.clock[TIME]), float(self._memory.clock[PENDING])
        if not math.isfinite(time_s):
            return 0
        step_s = time_s - seen_s
        if abs(step_s) > self._max_gap_s:
            believed = 0.0 < time_s - pending_s <= self._max_gap_s
            return (1 if step_s > 0.0 else -1) if believed else 0
        return int(not step_s <= 0.0)

    @property
    def reference_age_s(self) -> float:
        """Time since the speed over ground was last measured; infinite before the first."""
        return float(self._memory.clock[AGE])

    @property
    def dropped(self) -> Mapping[str, int]:
        """What was not taken so far, as counts by kind."""
        return _dropped(self._sensors, self._memory.counts)


def run_filter(
    model: FilterModel,
    noise: Noise,
    time_s: Array,
    z: Array,
    settings: FilterSettings = FilterSettings(),
) -> StateTrack:
    """Filter a whole log.

    Parameters
    ----------
    model : what is estimated, from what
    noise : how much either is off
    time_s : (n,) stamps, at any spacing
    z : (n, m) measurements, NaN where there is none
    settings : gates and gaps

    Returns
    -------
    StateTrack
        ``time_s`` increases strictly.  Left out and counted in ``dropped`` are rows whose stamp does not
        advance; the first row after a leap of more than ``max_gap_s`` either way, which is believed when the
        next stamp follows it (so that one bad stamp costs one row); and, of a clock that was set back, the
        rows up to the time that the track had reached: the filter takes them in, the track cannot hold them.

    Raises
    ------
    DataError
        where the shapes do not fit each other, the model or the noise.

    Notes
    -----
    After a leap, means are kept and all covariances but those of the positions go back to the initial one, or
    stay where they were when wider; positions are as uncertain as the speeds that this allows make them over
    the gap.  The means are kept because a logger pauses more often than a drive ends, and because what a gap
    does not change, as a gyro's bias, is best known from before; the covariance makes either harmless.
    """
    stamps = np.array(time_s, dtype=np.float64)
    memory = _memory(initial_state(model, noise))
    columns = _feed(model, noise, settings, stamps, z, noise.measurement_variance, memory)
    reached = np.maximum.accumulate(np.where(columns.taken, stamps, -np.inf))
    shown = columns.taken & (stamps > np.append(-np.inf, reached[:-1])[: stamps.size])
    dropped = _dropped(model.sensor_names, memory.counts)
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
        float(memory.clock[LIKELIHOOD]),
        dropped,
    )


def log_likelihood(
    model: FilterModel,
    noise: Noise,
    time_s: Array,
    z: Array,
    settings: FilterSettings = FilterSettings(gate_probability=1.0),
) -> float:
    """Return the log likelihood of a log without keeping its track; everything is believed by default."""
    memory = _memory(initial_state(model, noise))
    stamps = np.array(time_s, dtype=np.float64)
    _feed(model, noise, settings, stamps, z, noise.measurement_variance, memory, keep=False)
    return float(memory.clock[LIKELIHOOD])


class _Memory(NamedTuple):
    """What the kernel moves from sample to sample."""

    x: Array
    p: Array
    clock: Array
    rejected_s: Array
    counts: Array


class _Columns(NamedTuple):
    """What the kernel writes of each sample."""

    mean: Array
    cov: Array
    nis: Array
    nis_dof: Array
    use: Array
    reference_age_s: Array
    taken: Array


def _memory(state: FilterState) -> _Memory:
    clock = [state.time_s, state.pending_time_s, state.reference_age_s, state.log_likelihood]
    moved = (state.mean, state.cov, clock, state.rejected_s, state.counts)
    return _Memory(*(np.array(part, order="C") for part in moved))


def _dropped(sensors: tuple[str, ...], counts: Array) -> dict[str, int]:
    kinds = (*PER_ROW, *(f"{sensor} {what}" for sensor in sensors for what in PER_SENSOR))
    return {kind: count for kind, count in zip(kinds, counts.tolist(), strict=True) if count}


def _initial_variance(model: FilterModel, noise: Noise) -> Array:
    return np.diag(model.initial_std**2) if noise.initial_variance is None else noise.initial_variance


@lru_cache(maxsize=16)
def _matrices(model: FilterModel, noise: Noise) -> tuple[Array, Array]:
    """Return P0 and Q as the kernel wants them, once they are sure to fit the model."""
    d, m = len(model.states), len(model.rows)
    for name in ("process_variance", "initial_variance"):
        matrix = getattr(noise, name)
        if matrix is not None and len(matrix) != d:
            raise DataError(f"filter {model.name}: {name} is for {len(matrix)} states, it has {d}")
    if noise.measurement_variance.shape[-1] != m:
        given = noise.measurement_variance.shape[-1]
        raise DataError(f"filter {model.name}: measurement_variance is for {given} rows, it has {m}")
    return _initial_variance(model, noise).copy(), noise.process_variance.copy()


@lru_cache(maxsize=16)
def _thresholds(model: FilterModel, settings: FilterSettings) -> Array:
    """Return the largest squared innovation that is believed, by its number of rows."""
    widest = max(len(rows) for _, rows in model.sensors)
    found: Array = chdtri(np.arange(1.0, widest + 1), 1 - settings.gate_probability)
    return np.append(np.inf, found)


def _feed(
    model: FilterModel,
    noise: Noise,
    settings: FilterSettings,
    stamps: Array,
    z: Array,
    r: Array,
    memory: _Memory,
    *,
    keep: bool = True,
) -> _Columns:
    """Run the kernel, which moves the memory; return its columns, empty ones but the last unless kept."""
    matrices = _matrices(model, noise)
    n, k, d, m = len(stamps), len(model.sensors), len(model.states), len(model.rows)
    values = np.array(z, dtype=np.float64, order="C")
    variance = np.array(np.atleast_2d(r), dtype=np.float64, order="C")
    for name, given, desired in (
        ("time_s", stamps.shape, [(n,)]),
        ("z", values.shape, [(n, m)]),
        ("measurement_variance", variance.shape, [(n, m), (1, m)]),
    ):
        if given not in desired:
            raise DataError(f"filter {model.name}: {name} has shape {given}, {desired[0]} is needed")
    rows = n if keep else 0
    columns = _Columns(
        np.empty((rows, d)),
        np.empty((rows, d, d)),
        np.empty((rows, k)),
        np.empty((rows, k), np.int8),
        np.empty((rows, k), np.int8),
        np.empty(rows),
        np.zeros(n, np.bool_),
    )
    run(
        *model._constants,
        *matrices,
        _thresholds(model, settings),
        variance,
        settings.reopen_after_s - _SLACK_S,
        settings.max_gap_s + _SLACK_S,
        stamps,
        values,
        *memory,
        *columns,
    )
    return columns
