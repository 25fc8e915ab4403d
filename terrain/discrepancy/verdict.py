"""The diagnosis: what the simulation gets wrong, with which evidence, and what could not be detected.

The fields of these records are the keys of ``terrain explain --json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from terrain.discrepancy.health.fault import Fault
from terrain.discrepancy.health.unfit import Clock
from terrain.discrepancy.runs import Excluded
from terrain.records import Array

AGREE_P = 0.01
"""Probability below which sessions of one terrain do not agree: of some six values of a diagnosis, hardly
any by chance."""

INTERVAL_T = 2.36  #: Half a 95 % interval in standard deviations: t with the 7 degrees that eight runs give


class Verdict(StrEnum):
    """Outcome of a diagnosis.

    ``REFUSED`` is never the verdict of a :class:`Diagnosis`: blind trials use it for a diagnosis that ended
    in a ``DataError``.
    """

    NONE = "none"
    EXPLAINED = "explained"
    AMBIGUOUS = "ambiguous"
    UNEXPLAINED = "unexplained"
    VARIES = "varies"
    NOT_EXCITED = "not_excited"
    REFUSED = "refused"


class Value(NamedTuple):
    """A parameter's value, and the interval (low, high) that holds it with 95 %."""

    name: str
    value: float
    unit: str
    low: float
    high: float

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        return {"name": self.name, "value": self.value, "unit": self.unit, "ci": (self.low, self.high)}


class Cause(NamedTuple):
    """An effect that the measured runs have and the simulation lacks."""

    name: str
    aliases: tuple[str, ...]
    parameters: tuple[Value, ...]  #: values, over what the simulation has of them already
    #: ratio of the whitened squared residual that it removes from runs left out of its fit
    held_out_gain: float
    gain_ci: tuple[float, float]  #: its 95 % interval by bootstrap over runs
    channels: tuple[str, ...]  #: where it shows, the clearest first
    z: float  #: its evidence, see :class:`terrain.discrepancy.evidence.WaldTest`
    dispersion: float  #: as there
    caveat: str = ""  #: what the values depend on, in words; empty where they are the same throughout


class RunGroup(NamedTuple):
    """Runs in which a parameter has one value, and the standard deviation of that."""

    value: float
    std: float
    runs: tuple[str, ...]


class Varying(NamedTuple):
    """An effect whose size differs from run to run."""

    name: str
    parameter: str  #: of the effect, that differs most clearly
    unit: str
    rivals: tuple[str, ...]  #: effects that explain the differences as well
    mean: float  #: of the values over runs
    scatter: float
    z: float  #: evidence of the difference, as a standard normal number
    groups: tuple[RunGroup, ...]
    """Two groups of runs, the smaller value first; empty where values are spread."""
    channel: str  #: where it shows most


class SessionValue(NamedTuple):
    """A parameter fitted to the runs of one session, beside the same causes as in all sessions."""

    session: str
    runs: int  #: that were compared
    value: float
    ci: tuple[float, float]  #: 95 % interval with the scatter of runs
    text: str  #: value and interval in quantities of the robot's description


class BySession(NamedTuple):
    """A parameter of a named cause by session, of the sessions of one terrain."""

    name: str
    unit: str
    terrain: str  #: label of the runs
    sessions: tuple[SessionValue, ...]
    p: float  #: probability of such differences where sessions agree; NaN for one session
    #: standard deviation between sessions beyond that of their values; NaN for one session
    between_std: float
    agree: bool  #: whether sessions may have one value (``p`` from :data:`AGREE_P`); one session does


class Unexplained(NamedTuple):
    """A channel whose residual depends on an input, without an effect that explains it."""

    channel: str
    input: str
    z: float  #: evidence, in standard deviations
    residual_ratio: float  #: part of the channel's whitened squared residual that depends on the input


class Limit(NamedTuple):
    """The smallest value of an effect that these runs would have revealed nine times in ten."""

    name: str
    detection_limit: float
    unit: str
    needs: str


class RuledOut(NamedTuple):
    """An effect that is not the answer: why, its evidence, and the values of one that was withdrawn."""

    name: str
    reason: str
    z: float
    parameters: tuple[Value, ...] = ()


class Residual(NamedTuple):
    """How far measured and simulated are apart in one channel, behind the common low-pass."""

    rms: float  #: of measured minus simulated
    noise: float  #: of what is left when all parameters of the library are freed
    systematic: float  #: part of the square that is not noise, from 0 to 1


class NextDrive(NamedTuple):
    """The next drive, and what it would distinguish or reveal."""

    #: speed ahead and to the left in m/s, yaw rate in rad/s, for how many s it is held, and acceleration of the ramp
    #: to it in m/s^2
    legs: tuple[tuple[float, ...], ...]
    grade_deg: float  #: slope that it is driven on, which it starts up
    reason: str
    duration_s: float
    length_m: float  #: size of the field that it takes, along and across the heading at its start
    width_m: float


class Covariance(NamedTuple):
    """Covariance (k, k) of the values of parameters."""

    parameters: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What :func:`terrain.discrepancy.diagnose.diagnose` states.

    The verdict is ``explained`` where a cause is named, also when something else is left unexplained, and
    ``varies`` where what was found has no value that all runs share.
    """

    robot: str
    verdict: Verdict
    causes: tuple[Cause, ...]
    covariance: Covariance  #: of the causes' parameters
    ambiguous_sets: tuple[tuple[str, ...], ...]
    """Effects of which one is present, not distinguished; best fit first."""
    ambiguous_values: dict[str, tuple[Value, ...]]  #: fitted values of each of them, by the effect's name
    unexplained: tuple[Unexplained, ...]
    detection_limits: tuple[Limit, ...]  #: of every effect
    not_excited: tuple[Limit, ...]  #: those beyond what an effect may be
    ruled_out: tuple[RuledOut, ...]
    excluded_runs: tuple[Excluded, ...]
    clocks: tuple[Clock, ...]
    next_drive: NextDrive | None  #: None where nothing is to be distinguished
    residual_before: dict[str, Residual]  #: by channel, with the simulation given
    residual_after: dict[str, Residual]  #: with the causes built in
    n_runs: int  #: that were compared
    varying: tuple[Varying, ...] = ()
    faults: tuple[Fault, ...] = ()  #: of channels, which were repaired before anything was compared
    by_session: tuple[BySession, ...] = ()  #: values of the named causes; empty where runs are of one session

    @property
    def values(self) -> dict[str, float]:
        """The parameters of all named causes."""
        return {value.name: value.value for cause in self.causes for value in cause.parameters}
