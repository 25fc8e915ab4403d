"""The frozen records that pass between the stages, and nothing else.

``RunLog -> SlipTrack -> Windows -> features -> terrain class -> SlipTarget``.  Records hold read-only
arrays in SI units; units stand in the names.  They check their own shapes on construction, so that a
function given a record may trust it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pandas as pd

Array = NDArray[Any]


def read_only(array: Any, dtype: Any = np.float64) -> Array:
    """Return ``array`` as a read-only C-contiguous array (copied only when writable).

    Examples
    --------
    >>> read_only([1, 2]).flags.writeable
    False
    """
    fixed = np.ascontiguousarray(array, dtype=dtype)
    if fixed.flags.writeable:
        fixed = fixed.copy()
        fixed.flags.writeable = False
    return fixed


class Label(NamedTuple):
    """The terrain under the robot between two times; ``[start_s, end_s)`` on the clock of the run."""

    start_s: float
    end_s: float
    terrain: str


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """Samples of one logger: ``values[i]`` was sampled at ``time_s[i]``."""

    time_s: Array  #: (n,) seconds, strictly increasing
    values: Array  #: (n, c) SI units; NaN where a sample is missing
    channels: tuple[str, ...]  #: c names, each ending in its unit (``gyro_z_radps``)

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", read_only(self.time_s))
        object.__setattr__(self, "values", read_only(self.values))
        object.__setattr__(self, "channels", tuple(self.channels))
        if self.values.shape != (self.time_s.size, len(self.channels)):
            raise ValueError(
                f"values have shape {self.values.shape}, times and channels ask for "
                f"{(self.time_s.size, len(self.channels))}"
            )

    def __len__(self) -> int:
        return int(self.time_s.size)

    @property
    def rate_hz(self) -> float:
        """Median sampling rate in Hz; NaN with fewer than two samples."""
        return float(1.0 / np.median(np.diff(self.time_s))) if len(self) > 1 else float("nan")

    @property
    def duration_s(self) -> float:
        """Time from the first to the last sample in seconds; 0 for an empty stream."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    def channel(self, name: str) -> Array:
        """Values (n,) of one channel; ``KeyError`` when the stream has no such channel."""
        try:
            return self.values[:, self.channels.index(name)]
        except ValueError:
            raise KeyError(name) from None

    def columns(self, names: Iterable[str]) -> Array:
        """Return the values (n, k) of some channels; ``KeyError`` when the stream lacks one."""
        return np.column_stack([self.channel(name) for name in names])

    def to_pandas(self) -> pd.DataFrame:
        """Return a column a channel, by time in s."""
        import pandas as pd

        return pd.DataFrame(
            self.values, index=pd.Index(self.time_s, name="time_s"), columns=list(self.channels)
        )


@dataclass(frozen=True, slots=True, eq=False)
class RunLog:
    """One uninterrupted recording of one robot: several streams at their own rates, and its labels."""

    run_id: str  #: unique within a data set
    robot: str  #: name of a robot description (``data/robots/<robot>.yaml``)
    #: by name: ``imu``, ``wheels``, ``steering``, ``odometry``, ``commands``, ``slip``, ``estimator``,
    #: ``truth``
    streams: Mapping[str, Stream]
    #: terrain intervals; one for the whole run in the simple case, none when unlabelled
    labels: tuple[Label, ...] = ()
    source: str = ""  #: where the log comes from, as text
    #: what a reader removed or changed, as counts by kind; after a strict read no more than signs and axes
    #: that were turned, and what the log lacks
    dropped: Mapping[str, int] = field(default_factory=dict)
    #: outing that the run is part of, by name: runs of one session share what changes from one to the next, as
    #: the weather, the ground and how the sensors were mounted; empty where unknown
    session: str = ""
    #: that made the streams ``estimator``, ``slip`` and ``state``, by name; empty without them
    filter: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "streams", MappingProxyType(dict(self.streams)))
        object.__setattr__(self, "labels", tuple(map(Label._make, self.labels)))
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))

    @property
    def start_s(self) -> float:
        """First instant at which every stream has begun."""
        return float(max(stream.time_s[0] for stream in self.streams.values()))

    @property
    def end_s(self) -> float:
        """Last instant at which every stream still runs."""
        return float(min(stream.time_s[-1] for stream in self.streams.values()))

    @property
    def terrains(self) -> tuple[str, ...]:
        """The distinct terrain labels in order of appearance."""
        return tuple(dict.fromkeys(map(attrgetter("terrain"), self.labels)))

    def to_pandas(self) -> pd.DataFrame:
        """Return a column a channel, ``(stream, channel)``, by time in s; NaN where a stream has no sample."""
        import pandas as pd

        return pd.concat(
            {name: stream.to_pandas() for name, stream in self.streams.items()}, axis=1
        ).sort_index()

    def __repr__(self) -> str:
        on = f" on {', '.join(self.terrains)}" if self.labels else ""
        return f"RunLog({self.run_id!r}, {self.robot}{on}, streams: {', '.join(self.streams)})"


class Reading(NamedTuple):
    """Samples of one stream that arrived together: stamps ``time_s (k,)`` and ``values (k, c)``."""

    time_s: Array
    values: Array


class Sample(NamedTuple):
    """What a controller is given at one of its steps."""

    time_s: float  #: of the step
    twist: Array  #: (3,) desired ``(speed_x_mps, speed_y_mps, yaw_rate_radps)``
    #: by stream, what arrived since the previous step; a stream without new samples is missing
    readings: Mapping[str, Reading]
    terrain: str = ""  #: true terrain under the wheels where it is known, as in a simulation; else empty


class Command(NamedTuple):
    """What a controller commands the wheels to do."""

    #: (wheels,), as ``steer_rad``
    wheel_radps: Array
    steer_rad: Array
    twist: Array  #: (3,) the part of the desired twist that is driven
    status: Mapping[str, float]  #: figures of the decision, by name ending in a unit; always the same names


#: How a filter used a sensor's measurement at one step (:attr:`StateTrack.use`).
ABSENT, USED, GATED, REOPENED = 0, 1, 2, 3


@dataclass(frozen=True, slots=True, eq=False)
class StateTrack:
    """State estimate of a filter over time, and how consistent its measurements were with it."""

    time_s: Array  #: (n,) seconds
    mean: Array  #: (n, d) state after the measurements of that instant
    cov: Array  #: (n, d, d) its covariance, or (n, d) the variances, where no more is known
    states: tuple[str, ...]  #: name of each state, ending in its unit
    #: (n, k) squared innovation of each sensor over its covariance; NaN where it gave nothing
    nis: Array = field(default_factory=partial(np.empty, (0, 0)))
    nis_dof: Array = field(default_factory=partial(np.empty, (0, 0)))  #: (n, k) number of measurements in it
    #: (n, k) :data:`ABSENT`, :data:`USED`, :data:`GATED` or :data:`REOPENED`
    use: Array = field(default_factory=partial(np.empty, (0, 0)))
    sensors: tuple[str, ...] = ()  #: name of each of the k sensors; none of a filter that does not tell
    #: (n,) time since a sensor of speed over ground was last used, infinite before the first; NaN by default
    reference_age_s: Array = field(default_factory=partial(np.empty, 0))
    log_likelihood: float = float("nan")  #: of all measurements that were used
    #: measurements that the filter did not accept, as counts by kind
    dropped: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, d, k = len(self.time_s), len(self.states), len(self.sensors)
        if not k:
            for name in ("nis", "nis_dof", "use"):
                object.__setattr__(self, name, np.empty((n, 0)))
        if not len(self.reference_age_s):
            object.__setattr__(self, "reference_age_s", np.full(n, np.nan))
        for name in ("time_s", "mean", "cov", "nis", "reference_age_s"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        for name in ("nis_dof", "use"):
            object.__setattr__(self, name, read_only(getattr(self, name), np.int8))
        object.__setattr__(self, "dropped", MappingProxyType(dict(self.dropped)))
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("nis", "nis_dof", "use"), (n, k))
        shapes |= {
            "mean": (n, d),
            "cov": (n, d) if self.cov.ndim == 2 else (n, d, d),
            "reference_age_s": (n,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, {shape} is needed")

    def state(self, name: str) -> Array:
        """Return the mean (n,) of one state; ``ValueError`` when there is none of that name."""
        return self.mean[:, self.states.index(name)]

    def std(self, name: str) -> Array:
        """Return the standard deviation (n,) of one state."""
        i = self.states.index(name)
        return np.sqrt(self.cov[:, i, i] if self.cov.ndim == 3 else self.cov[:, i])


@dataclass(frozen=True, slots=True, eq=False)
class SlipTrack:
    """Slip of wheels, tracks or axles over time; NaN where it is undefined, never a silent 0."""

    time_s: Array  #: (n,) seconds
    mean: Array  #: (n, k) positive in traction
    std: Array  #: (n, k) one standard deviation
    #: name of each slip, with its unit: ``slip_<wheel>_ratio``, or of a slip angle ``slip_<axle>_rad``
    channels: tuple[str, ...]
    #: (n,) true where the speed over ground was not measured lately; never by default
    stale: Array = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def __post_init__(self) -> None:
        for name in ("time_s", "mean", "std"):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        stale = self.stale if len(self.stale) else np.zeros(self.time_s.size, dtype=bool)
        object.__setattr__(self, "stale", read_only(stale, np.bool_))
        shape = (self.time_s.size, len(self.channels))
        if self.mean.shape != shape or self.std.shape != shape:
            raise ValueError(f"mean and std must both have shape {shape}")
        if self.stale.shape != shape[:1]:
            raise ValueError(f"stale must have shape {shape[:1]}")

    @property
    def wheels(self) -> tuple[str, ...]:
        """Name of each wheel, track or axle."""
        return tuple(channel.removeprefix("slip_").rpartition("_")[0] for channel in self.channels)

    @property
    def ratios(self) -> SlipTrack:
        """The slips that are ratios, and no angles."""
        of = [k for k, channel in enumerate(self.channels) if channel.endswith("_ratio")]
        if len(of) == len(self.channels):
            return self
        channels = tuple(self.channels[k] for k in of)
        return SlipTrack(self.time_s, self.mean[:, of], self.std[:, of], channels, self.stale)

    def as_stream(self) -> Stream:
        """Return the slips as the stream ``slip`` of a log."""
        return Stream(self.time_s, self.mean, self.channels)


WINDOW_COLUMNS = ("start_s", "run_id", "terrain", "session")  #: Of :class:`Windows`, one entry a window


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Equal cuts from run logs: the samples that scikit-learn sees.

    Supports ``len``, ``shape`` and indexing by an integer or boolean array or a slice, so that
    ``cross_validate(recipe, windows, windows.terrain, groups=windows.run_id)`` works.
    """

    values: Mapping[str, Array]  #: per stream ``(n_windows, n_channels, n_samples)``
    channels: Mapping[str, tuple[str, ...]]  #: per stream the channel names
    rate_hz: Mapping[str, float]  #: per stream the sampling rate
    length_s: float  #: nominal length of a window
    start_s: Array  #: (n_windows,) start on the clock of the run
    run_id: Array  #: (n_windows,) run of each window
    terrain: Array  #: (n_windows,) label, ``""`` where there is none
    #: (n_windows,) of the run of each window, ``""`` where it names none; none by default
    session: Array = field(default_factory=partial(np.empty, 0, dtype=object))

    def __post_init__(self) -> None:
        for name in ("values", "channels", "rate_hz"):
            object.__setattr__(self, name, dict(getattr(self, name)))
        n = len(self.start_s)
        if not len(self.session):
            object.__setattr__(self, "session", np.full(n, "", dtype=object))
        for name, values in self.values.items():
            if values.ndim != 3 or values.shape[:2] != (n, len(self.channels[name])):
                raise ValueError(f"stream {name}: shape {values.shape} does not fit {n} windows")
        if not len(self.run_id) == len(self.terrain) == len(self.session) == n:
            raise ValueError("start_s, run_id, terrain and session must have one entry a window")

    def __len__(self) -> int:
        return len(self.start_s)

    @property
    def groups(self) -> Array:
        """Return session, or run where it names none, and run (n_windows, 2) of each window, as text.

        Examples
        --------
        >>> run = np.array(["a", "b"], dtype=object)
        >>> Windows({}, {}, {}, 2.0, np.zeros(2), run, run, np.array(["monday", ""], dtype=object)).groups.tolist()
        [['monday', 'a'], ['b', 'b']]
        """
        session, run = self.session.astype(str), self.run_id.astype(str)
        return np.stack([np.where(session == "", run, session), run], axis=1)

    @property
    def shape(self) -> tuple[int, int]:
        """(n_windows, total samples a window), as scikit-learn reads the size of ``X``."""
        return len(self), sum(v.shape[1] * v.shape[2] for v in self.values.values())

    def to_pandas(self, stream: str | None = None) -> pd.DataFrame:
        """Return a row a window; or of one stream a row a sample, by window and time in s from its start.

        Parameters
        ----------
        stream : its samples are given; without one, run, start, length and label of each window
        """
        import pandas as pd

        if stream is None:
            of_windows = {"run_id": self.run_id, "start_s": self.start_s, "terrain": self.terrain}
            return pd.DataFrame(of_windows).assign(length_s=self.length_s)
        values = np.swapaxes(self.values[stream], 1, 2)
        times_s = np.arange(values.shape[1]) / self.rate_hz[stream]
        index = pd.MultiIndex.from_product([range(len(self)), times_s], names=["window", "time_s"])
        columns = list(self.channels[stream])
        return pd.DataFrame(values.reshape(-1, len(columns)), index=index, columns=columns)

    def __repr__(self) -> str:
        runs, named = len(set(self.run_id)), sorted(set(self.terrain) - {""})
        return f"{len(self)} windows of {self.length_s:g} s from {runs} runs" + (
            f": {', '.join(named)}" if named else ""
        )

    def __getitem__(self, index: Any) -> Windows:
        if isinstance(index, int | np.integer):
            index = [int(index)]
        values = {name: values[index] for name, values in self.values.items()}
        return replace(self, values=values, **{name: getattr(self, name)[index] for name in WINDOW_COLUMNS})


class TargetStatus(StrEnum):
    """Origin of a target slip: assumed, learned from runs, or learned and contradictory."""

    UNESTIMATED = "unestimated"
    ESTIMATED = "estimated"
    INVALID = "invalid"


class SlipTarget(NamedTuple):
    """Slip ratio to aim for on a terrain in a drive state.

    ``status`` is ``unestimated`` (an assumed number), ``estimated`` (learned from ``n_runs`` runs of ``n_sessions``
    sessions; those that name none are of one) or ``invalid``.  ``slip_std`` is that of a new session where
    sessions show it, and NaN where it was not estimated.
    """

    terrain: str
    drive_state: str
    slip_ratio: float
    slip_std: float
    n_runs: int
    status: TargetStatus
    source: str
    n_sessions: int = 0
