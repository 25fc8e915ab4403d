"""What a filter is made of: its model, its noise, and when it does not believe a measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from terrain.errors import ConfigError, LogError
from terrain.estimation.ekf.arrays import ModelArrays
from terrain.estimation.ekf.kernel import OBSERVE, PROPAGATE
from terrain.logs.schema import unit_of
from terrain.records import Array, read_only

GATE_PROBABILITY = 1.0 - 1e-6
"""Five standard deviations: a wheel that starts to slip is a surprise of four, and no fault."""

REOPEN_AFTER_S = 0.2
"""Spikes last a sample or two; what disagrees for longer is the ground's doing, a brake or a bump."""


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
        (m, d) that are not zero.  Both are compiled with signatures of
        :mod:`terrain.estimation.ekf.kernel`, as ``@njit(PROPAGATE, cache=True)``: with an explicit one numba
        finds them again on disk
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
                raise ConfigError(
                    f"filter {self.name}: {what} must be compiled as @njit({what.upper()}, cache=True)"
                )

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
        """Refuse a name without a unit, one that is given twice, and one that refers to nothing."""
        place = f"filter {self.name}"
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

    @cached_property
    def arrays(self) -> ModelArrays:
        """What the kernel is given beside the two functions."""

        def marks(names: tuple[str, ...], chosen: tuple[str, ...]) -> Array:
            return np.array([name in chosen for name in names], dtype=np.bool_)

        order = [self.rows.index(row) for _, rows in self.sensors for row in rows]
        starts = np.cumsum([0, *(len(rows) for _, rows in self.sensors)])
        return ModelArrays(
            np.append(self.params, np.zeros(len(self.inputs))),
            np.array(order, dtype=np.int64),
            starts.astype(np.int64),
            is_reference=marks(self.sensor_names, self.references),
            is_held=marks(self.sensor_names, self.held),
            is_angle_row=marks(self.rows, self.angle_rows),
            is_angle_state=marks(self.states, self.angle_states),
            is_position=marks(self.states, self.positions),
            x0=self.initial_mean.copy(),
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


class Given(NamedTuple):
    """What is known of a sample, or of each of n, beside its measurements; None where that is nothing.

    Parameters
    ----------
    measurement_variance : (m,) in place of that of the noise
    walk_variance : (d,) per second up to the sample, beside the process variance
    inputs : (k,) of the step up to the sample
    """

    measurement_variance: Array | None = None
    walk_variance: Array | None = None
    inputs: Array | None = None


NOTHING_GIVEN = Given()


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
        row observes; else all that it does.  A sensor that the model
        holds takes two seconds at least
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
