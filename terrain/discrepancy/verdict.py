"""The diagnosis: what the simulation gets wrong, with which evidence, and what could not be detected.

The fields of these records are the keys of ``terrain explain --json``.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from terrain.discrepancy.faults import Fault
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
    """An effect that the measured runs have and the simulation lacks.

    Parameters
    ----------
    name, aliases : of the effect
    parameters : its values, over what the simulation has of them already
    held_out_gain, gain_ci : ratio of the whitened squared residual that it removes from runs left out of its
        fit, and its 95 % interval by bootstrap over runs
    channels : where it shows, the clearest first
    z, dispersion : its evidence, see :class:`terrain.discrepancy.selection.WaldTest`
    caveat : what the values depend on, in words; empty where they are the same throughout
    """

    name: str
    aliases: tuple[str, ...]
    parameters: tuple[Value, ...]
    held_out_gain: float
    gain_ci: tuple[float, float]
    channels: tuple[str, ...]
    z: float
    dispersion: float
    caveat: str = ""


class RunGroup(NamedTuple):
    """Runs in which a parameter has one value, and the standard deviation of that."""

    value: float
    std: float
    runs: tuple[str, ...]


class Varying(NamedTuple):
    """An effect whose size differs from run to run.

    Parameters
    ----------
    name, parameter, unit : of the effect
    rivals : effects that explain the differences as well
    mean, scatter : of the values over runs
    z : evidence of the difference, as a standard normal number
    groups : two groups of runs, the smaller value first; empty where values are spread
    channel : where it shows most
    """

    name: str
    parameter: str
    unit: str
    rivals: tuple[str, ...]
    mean: float
    scatter: float
    z: float
    groups: tuple[RunGroup, ...]
    channel: str


class SessionValue(NamedTuple):
    """A parameter fitted to the runs of one session, beside the same causes as in all sessions.

    Parameters
    ----------
    session, runs : name, and number of runs that were compared
    value, ci : of the parameter, and its 95 % interval with the scatter of runs
    text : value and interval in quantities of the robot's description
    """

    session: str
    runs: int
    value: float
    ci: tuple[float, float]
    text: str


class BySession(NamedTuple):
    """A parameter of a named cause by session, of the sessions of one terrain.

    Parameters
    ----------
    name, unit, terrain : of the parameter, and the label of the runs
    sessions : values
    p : probability of such differences where sessions agree; NaN for one session
    between_std : standard deviation between sessions beyond that of their values; NaN for one session
    agree : whether sessions may have one value (``p`` from :data:`AGREE_P`); one session does
    """

    name: str
    unit: str
    terrain: str
    sessions: tuple[SessionValue, ...]
    p: float
    between_std: float
    agree: bool


class Unexplained(NamedTuple):
    """A channel whose residual depends on an input, without an effect that explains it.

    Parameters
    ----------
    channel, input : names
    z : evidence, in standard deviations
    residual_ratio : part of the channel's whitened squared residual that depends on it
    """

    channel: str
    input: str
    z: float
    residual_ratio: float


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
    """How far measured and simulated are apart in one channel, behind the common low-pass.

    Parameters
    ----------
    rms : of measured minus simulated
    noise : of what is left when all parameters of the library are freed
    systematic : part of the square that is not noise, from 0 to 1
    """

    rms: float
    noise: float
    systematic: float


class NextDrive(NamedTuple):
    """The next drive: a scenario of ``terrain simulate``, and what it would distinguish or reveal."""

    scenario: str
    grade_deg: float
    reason: str


class Excluded(NamedTuple):
    """A run that is excluded as unfit, and why."""

    run_id: str
    reason: str


class Clock(NamedTuple):
    """Delay of the IMU's and the camera's logger behind the wheels' in a run, and its standard deviation."""

    run_id: str
    offset_s: float
    std_s: float


class Covariance(NamedTuple):
    """Covariance (k, k) of the values of parameters."""

    parameters: tuple[str, ...]
    matrix: Array


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What :func:`terrain.discrepancy.diagnose.diagnose` states.

    Parameters
    ----------
    robot : name
    verdict : ``explained`` where a cause is named, also when something else is left unexplained; ``varies``
        where what was found has no value that all runs share
    causes : named
    covariance : of their parameters
    ambiguous_sets : effects of which one is present, and which these runs cannot distinguish; best fit first
    ambiguous_values : fitted values of each of them, by the effect's name
    unexplained : channels that depend on an input without a known cause
    detection_limits : of every effect
    not_excited : those whose limit is beyond what an effect may be
    ruled_out : effects that are not the answer
    excluded_runs, clocks : by run
    next_drive : None where nothing is to be distinguished
    residual_before, residual_after : by channel, with the simulation given and with the causes built in
    n_runs : that were compared
    varying : effects whose size differs from run to run
    faults : of channels, which were repaired before anything was compared
    by_session : values of the named causes by terrain and session; empty where runs are of one session
    """

    robot: str
    verdict: Verdict
    causes: tuple[Cause, ...]
    covariance: Covariance
    ambiguous_sets: tuple[tuple[str, ...], ...]
    ambiguous_values: dict[str, tuple[Value, ...]]
    unexplained: tuple[Unexplained, ...]
    detection_limits: tuple[Limit, ...]
    not_excited: tuple[Limit, ...]
    ruled_out: tuple[RuledOut, ...]
    excluded_runs: tuple[Excluded, ...]
    clocks: tuple[Clock, ...]
    next_drive: NextDrive | None
    residual_before: dict[str, Residual]
    residual_after: dict[str, Residual]
    n_runs: int
    varying: tuple[Varying, ...] = ()
    faults: tuple[Fault, ...] = ()
    by_session: tuple[BySession, ...] = ()

    @property
    def values(self) -> dict[str, float]:
        """The parameters of all named causes."""
        return {value.name: value.value for cause in self.causes for value in cause.parameters}
