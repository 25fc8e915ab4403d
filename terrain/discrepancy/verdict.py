"""The diagnosis: what the simulation gets wrong, with which evidence, and what could not be detected."""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any, NamedTuple

from terrain.discrepancy.faults import Fault
from terrain.records import Array

AGREE_P = 0.01
"""Probability below which sessions of one terrain do not agree: of some six values of a diagnosis, hardly
any by chance."""


INTERVAL_T = 2.36
"""Half a 95 % interval in standard deviations: t with the 7 degrees that eight runs give."""


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
    """A parameter that was found, and the interval (low, high) that holds it with 95 %."""

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
    values : its parameters, over what the simulation has of them already
    gain, gain_low, gain_high : ratio of the whitened squared residual that it removes from runs left out of
        its fit, and its 95 % interval by bootstrap over runs
    channels : where it shows, the clearest first
    z, dispersion : its evidence, see :class:`terrain.discrepancy.selection.WaldTest`
    caveat : what the values depend on, in words; empty where they are the same throughout
    """

    name: str
    aliases: tuple[str, ...]
    values: tuple[Value, ...]
    gain: float
    gain_low: float
    gain_high: float
    channels: tuple[str, ...]
    z: float
    dispersion: float
    caveat: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        own = {
            name: getattr(self, name) for name in ("name", "aliases", "channels", "z", "dispersion", "caveat")
        }
        interval = self.gain_low, self.gain_high
        return {**own, "parameters": self.values, "held_out_gain": self.gain, "gain_ci": interval}


class RunGroup(NamedTuple):
    """Runs in which a parameter has one value, and the standard deviation of that."""

    value: float
    std: float
    run_ids: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        return {"value": self.value, "std": self.std, "runs": self.run_ids}


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
    session, n_runs : name, and runs that were compared
    value, low, high, std : of the parameter, 95 % interval and standard deviation with the scatter of runs
    text : value and interval in quantities of the robot's description
    """

    session: str
    n_runs: int
    value: float
    low: float
    high: float
    std: float
    text: str

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = {"session": self.session, "runs": self.n_runs, "value": self.value}
        return {**named, "ci": (self.low, self.high), "text": self.text}


class BySession(NamedTuple):
    """A parameter of a named cause by session, of the sessions of one terrain.

    Parameters
    ----------
    parameter, unit, terrain : names
    sessions : values
    p : probability of such differences where sessions agree; NaN for one session
    between_std : standard deviation between sessions beyond that of their values; NaN for one session
    """

    parameter: str
    unit: str
    terrain: str
    sessions: tuple[SessionValue, ...]
    p: float
    between_std: float

    @property
    def agree(self) -> bool:
        """Whether sessions may have one value; one session does."""
        return not self.p < AGREE_P

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = self._asdict()
        return {"name": named.pop("parameter"), **named, "agree": self.agree}


class Unexplained(NamedTuple):
    """A channel whose residual depends on an input, without an effect that explains it.

    Parameters
    ----------
    channel, input : names
    z : evidence, in standard deviations
    ratio : part of the channel's whitened squared residual that depends on it
    """

    channel: str
    input: str
    z: float
    ratio: float

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = self._asdict()
        return {"residual_ratio": named.pop("ratio"), **named}


class Limit(NamedTuple):
    """The smallest value of an effect that these runs would have revealed nine times in ten."""

    name: str
    value: float
    unit: str
    needs: str

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = self._asdict()
        return {"detection_limit": named.pop("value"), **named}


class RuledOut(NamedTuple):
    """An effect that is not the answer, and why.

    Parameters
    ----------
    name : of the effect
    reason : a sentence
    z : its evidence
    values : fitted ones, of an effect that was withdrawn although it reduces the residual
    """

    name: str
    reason: str
    z: float
    values: tuple[Value, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the fields as JSON names them."""
        named = self._asdict()
        return {"parameters": named.pop("values"), **named}


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


@dataclass(frozen=True, slots=True, eq=False)
class Diagnosis:
    """What :func:`terrain.discrepancy.diagnose.diagnose` found.

    Parameters
    ----------
    robot : name
    verdict : ``explained`` where a cause is named, also when something else is left unexplained; ``varies``
        where what was found has no value that all runs share
    causes : named
    parameters, cov : names (k,) of their parameters, and the covariance (k, k) of the values
    ambiguous_sets : effects of which one is present, and which these runs cannot distinguish; best fit first
    ambiguous_values : fitted values of each of them, by the effect's name
    unexplained : channels that depend on an input without a known cause
    limits : detection limit of every effect
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
    parameters: tuple[str, ...]
    cov: Array
    ambiguous_sets: tuple[tuple[str, ...], ...]
    ambiguous_values: dict[str, tuple[Value, ...]]
    unexplained: tuple[Unexplained, ...]
    limits: tuple[Limit, ...]
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
        return {value.name: value.value for cause in self.causes for value in cause.values}

    def as_json(self) -> dict[str, Any]:
        """Return the fields by name, the covariance with the names of its rows."""
        named = {each.name: getattr(self, each.name) for each in fields(self)}
        parameters, cov, limits = (named.pop(name) for name in ("parameters", "cov", "limits"))
        return {
            **named,
            "covariance": {"parameters": parameters, "matrix": cov},
            "detection_limits": limits,
        }
