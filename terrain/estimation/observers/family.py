"""The interface of all observers of slip: memory in, measurements in, memory out.

An observer is a compiled step and what it reads out of its memory.  A row holds what was measured at a tick
of the wheels, NaN where a sensor gave nothing; it may be late, wrong or absent, and the memory that comes out
is finite whatever comes in.  Nothing is hidden in an object: a whole log (:func:`observe`), a run sample by
sample (:mod:`terrain.estimation.observers.live`) and a simulated robot call the same step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from terrain.records import Array, read_only
from terrain.status import StatusCode


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
    """What an observer knows at a tick.

    Parameters
    ----------
    mean, std : (d,) estimates and one standard deviation of each, in the order of :attr:`Observer.states`
    slip, slip_std : (k,) in the order of :attr:`Observer.slips`; NaN where it is not observed
    status : number of an :class:`ObserverStatus`
    """

    mean: Array
    std: Array
    slip: Array
    slip_std: Array
    status: int


Step = Callable[[Array, Array, Array, float], Array]
"""From parameters (p,), memory (s,), measurements (m,) and the time since the step before, in s, to the next
memory (s,), a new array; compiled."""


@dataclass(frozen=True, slots=True, eq=False)
class Observer:
    """An observer of slip.

    Parameters
    ----------
    name : as ``terrain estimate --filter`` has it
    states : name of each estimate, with its unit
    slips : channels of the stream ``slip``: ``slip_<wheel>_ratio`` or, of an angle, ``slip_<wheel>_rad``
    rows : what it takes at a tick, of :data:`terrain.estimation.observers.rows.ROWS`
    params : (p,) of its step: geometry, gains and limits
    start : (s,) memory before the first step
    step : from one memory to the next
    read : what a memory says
    """

    name: str
    states: tuple[str, ...]
    slips: tuple[str, ...]
    rows: tuple[str, ...]
    params: Array
    start: Array
    step: Step
    read: Callable[[Array, Array], ObserverOutput]

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", read_only(self.params))
        object.__setattr__(self, "start", read_only(self.start))


@dataclass(frozen=True, slots=True, eq=False)
class ObserverTrack:
    """Estimates of an observer over a run.

    Parameters
    ----------
    time_s : (n,)
    states, slips : names of the columns
    mean, std : (n, d)
    slip, slip_std : (n, k); NaN where slip is not observed
    status : (n,) numbers of :class:`ObserverStatus`
    """

    time_s: Array
    states: tuple[str, ...]
    slips: tuple[str, ...]
    mean: Array
    std: Array
    slip: Array
    slip_std: Array
    status: Array

    def state(self, name: str) -> Array:
        """Return the mean (n,) of one state; ``ValueError`` when there is none of that name."""
        return self.mean[:, self.states.index(name)]


def observe(observer: Observer, time_s: Array, rows: Array) -> ObserverTrack:
    """Run an observer over the rows of a whole log.

    Parameters
    ----------
    observer : any
    time_s : (n,) rising stamps of the ticks
    rows : (n, m) of :attr:`Observer.rows`; NaN where nothing was measured

    Notes
    -----
    The first step has a time of 0 since the step before: an observer only takes what it starts from.
    """
    memory = np.array(observer.start)
    readings = []
    for dt_s, row in zip(np.diff(time_s, prepend=time_s[:1]).tolist(), rows, strict=True):
        memory = observer.step(observer.params, memory, row, dt_s)
        readings.append(observer.read(observer.params, memory))
    n, d, k = len(time_s), len(observer.states), len(observer.slips)
    return ObserverTrack(
        time_s,
        observer.states,
        observer.slips,
        np.array([reading.mean for reading in readings]).reshape(n, d),
        np.array([reading.std for reading in readings]).reshape(n, d),
        np.array([reading.slip for reading in readings]).reshape(n, k),
        np.array([reading.slip_std for reading in readings]).reshape(n, k),
        np.array([reading.status for reading in readings], dtype=np.int64),
    )
