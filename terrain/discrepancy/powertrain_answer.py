"""What is between commanded and measured wheel speeds, as stated: parts with intervals, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import Any, NamedTuple

from terrain.discrepancy.command_response import ABSENT, NAMES
from terrain.records import Array

SCALE_TOLERANCE = 0.1
"""Gains further from 1 than that: the commands are no wheel speeds."""

WORDS = {
    "delay_s": "the wheels answer {} s late",
    "time_constant_s": "they settle with a time constant of {} s",
    "slew_radps2": "they speed up and slow down by at most {} rad/s²",
    "deadband_radps": "commands below {} rad/s do not move them",
    "gain_ratio": "they turn {} times as fast as commanded",
    "difference_gain_ratio": "they turn {} times as fast against each other as commanded",
    "common_limit_radps": "the mean of both sides is at most {} rad/s",
    "difference_limit_radps": "half the difference of the sides is at most {} rad/s",
    "wheel_limit_radps": "no wheel turns faster than {} rad/s",
}
"""What each part does, with a place for its value."""


LABELS = {
    "delay_s": "a delay",
    "time_constant_s": "a time constant",
    "slew_radps2": "a slew limit",
    "deadband_radps": "a deadband",
    "gain_ratio": "a gain",
    "difference_gain_ratio": "a gain of the difference of the sides",
    "common_limit_radps": "a limit of the mean of both sides",
    "difference_limit_radps": "a limit of the difference of the sides",
    "wheel_limit_radps": "a largest wheel speed",
}
"""What each part is called."""


class PartStatus(Enum):
    """Whether a part of the powertrain is there."""

    FOUND = "it reduces the error of runs left out"
    NOT_NEEDED = "it does not reduce the error of runs left out"
    NOT_EXCITED = "the commands would not show it"


class Part(NamedTuple):
    """One part of the powertrain.

    Parameters
    ----------
    name : of :data:`NAMES`, ends in its unit
    status : whether it is there
    value, low, high : with its 95 % interval over runs; NaN where it was not found.  A delay of wheels that
        then follow at once is known to a period of the logger at the best
    gain_ratio : of the squared error of runs left out, that it removes beside the others; NaN where not found
    """

    name: str
    status: PartStatus
    value: float
    low: float
    high: float
    gain_ratio: float

    @property
    def unit(self) -> str:
        """Last word of the name."""
        return self.name.rpartition("_")[2]


class Powertrain(NamedTuple):
    """From commanded to measured wheel speeds.

    Parameters
    ----------
    parts : in the order of :data:`NAMES`; without those of two sides where a robot has not just two
    rms_before_radps, rms_after_radps : measured minus commanded, and minus predicted of runs left out of the
        fit
    reduction : of the squared error of these runs, over that of the commands, with its 95 % interval over
        runs
    hold_s : period at which new wheel speeds are logged
    n_runs : that have both
    """

    parts: tuple[Part, ...]
    rms_before_radps: float
    rms_after_radps: float
    reduction: tuple[float, float, float]
    hold_s: float
    n_runs: int

    @property
    def found(self) -> tuple[Part, ...]:
        """Parts that are there."""
        return tuple(part for part in self.parts if part.status is PartStatus.FOUND)

    @property
    def vector(self) -> Array:
        """Values (len(NAMES),) as :func:`follow` takes them."""
        vector = ABSENT.copy()
        for part in self.found:
            vector[NAMES.index(part.name)] = part.value
        return vector

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was found, a sentence each, with its interval, what that gains, and what was not excited."""
        if not self.found:
            return ("The wheels turn as they are commanded, as far as the runs show it.", *self._missed)
        parts = ((WORDS[p.name].format(f"{p.value:.3g}"), f"{p.low:.3g} to {p.high:.3g}") for p in self.found)
        stated = [f"{words[0].upper()}{words[1:]} ({interval})." for words, interval in parts]
        if self.is_scaled:
            stated.append("The commands are no wheel speeds: they are scaled before the wheels get them.")
        ratio, low, high = self.reduction
        stated.append(
            f"On runs left out of the fit the wheel speeds are then off by {self.rms_after_radps:.3g} rad/s "
            f"rms instead of {self.rms_before_radps:.3g}, a squared error less by {ratio:.1%} ({low:.1%} to "
            f"{high:.1%})."
        )
        return (*stated, *self._missed)

    @property
    def _missed(self) -> tuple[str, ...]:
        """One sentence on the parts that the commands would not show, if there are any."""
        missed = [LABELS[part.name] for part in self.parts if part.status is PartStatus.NOT_EXCITED]
        return (f"The commands would not have shown {_either(missed)}.",) if missed else ()

    def as_json(self) -> dict[str, Any]:
        """Return the powertrain as JSON has it."""
        parts = [
            {
                "name": part.name,
                "unit": part.unit,
                "status": part.status.name.lower(),
                "value": part.value,
                "ci": (part.low, part.high),
                "held_out_gain": part.gain_ratio,
            }
            for part in self.parts
        ]
        return {"parts": parts, **{name: value for name, value in self._asdict().items() if name != "parts"}}

    @property
    def is_scaled(self) -> bool:
        """Whether commands are no wheel speeds: a gain is not 1."""
        gains = [part for part in self.found if "gain" in part.name]
        return any(abs(part.value - 1.0) > SCALE_TOLERANCE for part in gains)


class PowertrainAnswer(NamedTuple):
    """The powertrain of runs that log commands.

    Parameters
    ----------
    powertrain : None where it is not known
    reason : why it is not
    """

    powertrain: Powertrain | None
    reason: str = ""

    @property
    def sentences(self) -> tuple[str, ...]:
        """What is between commands and wheels, or why that is not known."""
        if self.powertrain is None:
            return (f"The wheel speeds are not compared with their commands: {self.reason}.",)
        return self.powertrain.sentences

    def as_json(self) -> dict[str, Any]:
        """Return the answer as JSON has it."""
        if self.powertrain is None:
            return {"measured": False, "reason": self.reason, "sentences": self.sentences}
        return {"measured": True, "sentences": self.sentences, **self.powertrain.as_json()}


def _either(names: Sequence[str]) -> str:
    return " or ".join([*([", ".join(names[:-1])] if names[1:] else []), names[-1]])
