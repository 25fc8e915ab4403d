"""The diagnosis: what the simulation gets wrong, with which evidence, and what could not be detected.

The fields of these records are the keys of ``terrain explain --json``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

from terrain.discrepancy.gain import Gain
from terrain.discrepancy.health.fault import Fault
from terrain.discrepancy.health.unfit import Clock
from terrain.discrepancy.patterns import Kind
from terrain.discrepancy.runs import Excluded
from terrain.records import Array

AGREE_P = 0.01
"""Probability below which sessions of one terrain do not agree: of some six values of a diagnosis, hardly
any by chance."""

INTERVAL_T = 2.36  #: Half a 95 % interval in standard deviations: t with the 7 degrees that eight runs give


class Tier(StrEnum):
    """What a statement of a diagnosis rests on; of a channel, or of a whole diagnosis, the first that holds.

    ========== ===============================================================================================
    named      One effect: its evidence is above the threshold, nothing else fits as well, and building it in
               removes, on data held out, a part of the square of the channels where it acts whose interval is
               above 0, and at least half of what the black-box learner removes there.
    set        The same of several effects that these runs do not distinguish: one of them is present.
    candidate  An effect with evidence that did not earn a name: below the threshold, not confirmed on data
               held out, withdrawn for the reason given, or without one value for all runs.  It is not built in.
    unexplained  Measured and simulated differ systematically, and no effect is named for it.
    not_shown  Nothing was found, and these drives could not have shown all that may be wrong: some effects, at
               the largest that they may be, would have stayed undetected.
    ========== ===============================================================================================

    Where nothing was found and these drives would have shown it there is none: measured and simulated agree.
    """

    NAMED = "named"
    SET = "set"
    CANDIDATE = "candidate"
    UNEXPLAINED = "unexplained"
    NOT_SHOWN = "not_shown"


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
    """An effect that the measured runs have and the simulation lacks, or a candidate for one."""

    name: str
    aliases: tuple[str, ...]
    parameters: tuple[Value, ...]  #: values, over what the simulation has of them already
    #: part of the square that it removes on data held out beside the others, where it acts; NaN of a candidate that
    #: was not judged there
    held_out_gain: float
    gain_ci: tuple[float, float]  #: its 95 % interval
    channels: tuple[str, ...]  #: where it shows, the clearest first
    z: float  #: its evidence, see :class:`terrain.discrepancy.evidence.WaldTest`
    dispersion: float  #: as there
    caveat: str = ""  #: what the values depend on, in words; empty where they are the same throughout
    tier: Tier = Tier.NAMED  #: named, set (of which it is the member that is built in), or candidate
    reason: str = ""  #: why it is no more than a candidate; empty where it is named


class RunGroup(NamedTuple):
    """Runs in which a parameter has one value, and the standard deviation of that."""

    value: float
    std: float
    runs: tuple[str, ...]
    name: str = ""  #: of their session or terrain, where that is what they have in common


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
    """Runs by what they have in common: of two groups and of sessions the smaller value first, of a change that before
    it, of a rogue run the others; empty for a trend, and where values are spread."""
    channel: str  #: where it shows most
    pattern: Kind = Kind.SPREAD
    change: float = math.nan
    """From the first run to the last along a trend, else from the first of the groups to the last; NaN without a
    pattern."""
    change_ci: tuple[float, float] = (math.nan, math.nan)  #: its 95 % interval
    latest: Value | None = None
    """After the last run, with the scatter of runs about the pattern: what the extension has of a trend or a change
    that no rival explains; None for all else, of which it has the mean, if that is a cause."""
    n_runs: int = 0  #: from the first of the order to the last, those between that were not compared counted


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
    """An effect that is not the answer: why, and its evidence."""

    name: str
    reason: str
    z: float


class Residual(NamedTuple):
    """How far measured and simulated are apart in one channel, behind the common low-pass."""

    rms: float  #: of measured minus simulated
    noise: float  #: of what is left when all parameters of the library are freed
    systematic: float  #: part of the square that is not noise, from 0 to 1


class ChannelVerdict(NamedTuple):
    """What is off in one channel, what is built in for it, and what that removes on data held out.

    The other fields are those of :class:`terrain.discrepancy.gain.ChannelGain`.
    """

    channel: str
    tier: Tier | None  #: None where measured and simulated agree
    causes: tuple[str, ...]  #: effects built in that act on it
    rms_before: float
    rms_after: float
    gain: float
    gain_ci: tuple[float, float]
    refused: bool
    learner_rms: float
    learner_gain: float
    learner_ci: tuple[float, float]
    left_ci: tuple[float, float]


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
    """What :func:`terrain.discrepancy.diagnose.diagnose` states; ``verdict`` is the first tier that holds."""

    robot: str
    verdict: Tier | None
    causes: tuple[Cause, ...]  #: that are named
    covariance: Covariance  #: of the parameters of all that is built in
    ambiguous_sets: tuple[tuple[str, ...], ...]
    """Effects of which one is present, not distinguished; best fit first."""
    ambiguous_values: dict[str, tuple[Value, ...]]  #: fitted values of each of them, by the effect's name
    unexplained: tuple[Unexplained, ...]
    detection_limits: tuple[Limit, ...]  #: of every effect
    not_shown: tuple[Limit, ...]  #: those beyond what an effect may be
    ruled_out: tuple[RuledOut, ...]
    excluded_runs: tuple[Excluded, ...]
    clocks: tuple[Clock, ...]
    next_drive: NextDrive | None  #: None where nothing is to be distinguished
    residual_before: dict[str, Residual]  #: by channel, with the simulation given
    residual_after: dict[str, Residual]  #: with these built in
    n_runs: int  #: that were compared
    varying: tuple[Varying, ...] = ()
    faults: tuple[Fault, ...] = ()  #: of channels, which were repaired before anything was compared
    by_session: tuple[BySession, ...] = ()  #: values of the named causes; empty where runs are of one session
    candidates: tuple[Cause, ...] = ()  #: the strongest evidence first
    of_sets: tuple[Cause, ...] = ()  #: of each set the effect that is built in, the likeliest
    channels: tuple[ChannelVerdict, ...] = ()
    gain: Gain | None = None  #: on data held out

    @property
    def values(self) -> dict[str, float]:
        """The parameters of all effects that extend the simulation."""
        return {value.name: value.value for cause in self.built_in for value in cause.parameters}

    @property
    def latest(self) -> tuple[Value, ...]:
        """The values after the last run of what follows the order of the runs, which the extension has."""
        return tuple([effect.latest for effect in self.varying if effect.latest is not None])

    @property
    def differing_channels(self) -> tuple[str, ...]:
        """The channels of the effect that varies, and of causes whose caveat is the run."""
        doubtful = [cause for cause in self.built_in if "run" in cause.caveat and cause.channels]
        return *[effect.channel for effect in self.varying], *[cause.channels[0] for cause in doubtful]

    @property
    def built_in(self) -> tuple[Cause, ...]:
        """The effects that extend the simulation: those named, and the best of each set."""
        return (*self.causes, *self.of_sets)
