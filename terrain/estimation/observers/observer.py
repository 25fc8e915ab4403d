"""Observers of slip: one row of measurements in, what is known of the slip out.

A row holds what was measured at a tick of the wheels (:data:`terrain.estimation.observers.rows.ROWS`), NaN where a
sensor gave nothing; it may be late, wrong or absent, and what comes out is never infinite.  A whole log
(:func:`observe`), a run sample by sample (:class:`~terrain.estimation.observers.rows.LiveObserver`) and a simulated
robot call the same step.

Most observers are a :class:`~terrain.estimation.filter.FilterModel` and what its inputs are:
:class:`FilterObserver`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from terrain.estimation.filter import Filter, FilterModel, FilterSettings, Noise
from terrain.records import GATED, REOPENED, USED, Array
from terrain.status import StatusCode

LONGEST_STEP_S = 1.0
"""A longer time since the step before is no step: a robot may have done anything."""


class ObserverStatus(StatusCode):
    """What the estimates of an observer are worth at a tick."""

    OK = 0
    """Estimates follow measurements."""
    STARTING = 1
    """Nothing that estimates need was measured yet."""
    STANDING = 2
    """The robot stands; slip is as it was, and does not drift."""
    PREDICTED = 3
    """No fix for a while: slip is as it was, the pose is dead reckoning."""
    REJECTED = 4
    """A measurement that cannot be, a jump or a flip, was left out."""
    RESET = 5
    """The pose began anew where measurements persistently are; slip is as it was."""
    UNEXCITED = 6
    """A part of the slip is not observable in this motion, a stopped track say, and is as it was."""
    PUSHED = 7
    """The robot turns though its tracks stand."""
    BAD_INPUT = 8
    """Speeds or time are not numbers that can be; estimates are as they were."""


class ObserverOutput(NamedTuple):
    """What an observer knows at a tick."""

    mean: Array  #: (d,) estimates and one standard deviation of each, in the order of :attr:`Observer.states`
    std: Array
    slip: Array  #: (k,) in the order of :attr:`Observer.slips`; NaN where it is not observed
    slip_std: Array
    status: int  #: number of an :class:`ObserverStatus`


class Observer(ABC):
    """An observer of slip in use.

    Attributes
    ----------
    name : as ``terrain estimate --filter`` has it
    states : name of each estimate, with its unit
    slips : channels of the stream ``slip``: ``slip_<wheel>_ratio`` or, of an angle, ``slip_<wheel>_rad``
    rows : what it takes at a tick, of :data:`terrain.estimation.observers.rows.ROWS`
    """

    name: str
    states: tuple[str, ...]
    slips: tuple[str, ...]
    rows: tuple[str, ...]

    @abstractmethod
    def step(self, row: Array, dt_s: float) -> ObserverOutput:
        """Take a row (m,) that comes a time after the one before, 0 at first; return what is known then."""


class FilterObserver(Observer):
    """An observer that is a filter: a subclass makes its inputs of a row, and its slips of the state.

    Parameters
    ----------
    model, noise, settings : of the filter

    Attributes
    ----------
    filter : with its state, which is all that is remembered but the inputs of the last tick
    age_s : (k,) time since each sensor was used, infinite before
    """

    def __init__(self, model: FilterModel, noise: Noise, settings: FilterSettings) -> None:
        self.filter = Filter(model, noise, settings)
        self.name = model.name
        self.age_s = np.full(len(model.sensors), np.inf)
        self._time_s = 0.0

    def advance(
        self,
        dt_s: float,
        z: Array,
        inputs: Array,
        walk: Array | None = None,
        variance: Array | None = None,
        n_judged: int | None = None,
    ) -> ObserverStatus:
        """Take a tick into the filter; return OK, or REJECTED or RESET where a sensor was left out or reopened.

        Parameters are those of :meth:`terrain.estimation.filter.Filter.step`; the first ``n_judged`` sensors count.
        """
        self._time_s += dt_s
        self.filter.step(self._time_s, z, variance, walk, inputs)
        use = self.filter.use
        self.age_s += dt_s
        self.age_s[(use == USED) | (use == REOPENED)] = 0.0
        use = use[:n_judged]
        if (use == REOPENED).any():
            return ObserverStatus.RESET
        return ObserverStatus.REJECTED if (use == GATED).any() else ObserverStatus.OK

    def place(self, states: slice, values: Array, std: Array) -> None:
        """Set some states, with standard deviations, whatever was known of them; others stay."""
        mean, cov = self.filter.mean, self.filter.cov
        mean[states], cov[states, :], cov[:, states] = values, 0.0, 0.0
        cov[states, states] = np.diag(np.square(std))


class ObserverTrack(NamedTuple):
    """Estimates of an observer over a run."""

    time_s: Array  #: (n,)
    states: tuple[str, ...]  #: names of the columns
    slips: tuple[str, ...]
    mean: Array  #: (n, d)
    std: Array
    slip: Array  #: (n, k); NaN where slip is not observed
    slip_std: Array
    status: Array  #: (n,) numbers of :class:`ObserverStatus`

    def state(self, name: str) -> Array:
        """Return the mean (n,) of one state; ``ValueError`` when there is none of that name."""
        return self.mean[:, self.states.index(name)]


def observe(observer: Observer, time_s: Array, rows: Array) -> ObserverTrack:
    """Run an observer over the rows of a whole log.

    Parameters
    ----------
    observer : before its first step
    time_s, rows : (n,) rising stamps of the ticks, and (n, m) of :attr:`Observer.rows`
    """
    steps_s = np.diff(time_s, prepend=time_s[:1]).tolist()
    outputs = [observer.step(row, dt_s) for dt_s, row in zip(steps_s, rows, strict=True)]
    n, d, k = len(time_s), len(observer.states), len(observer.slips)
    mean, std, slip, slip_std = (
        np.array([output[i] for output in outputs]).reshape(n, size) for i, size in enumerate((d, d, k, k))
    )
    status = np.array([output.status for output in outputs], dtype=np.int64)
    return ObserverTrack(time_s, observer.states, observer.slips, mean, std, slip, slip_std, status)
