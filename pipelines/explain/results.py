"""Results of ``terrain explain`` and ``terrain explain-trials``, for screens, figures and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from pipelines.explain.wording import terrain_notes
from terrain.discrepancy.compared import ComparedRun
from terrain.discrepancy.filter_gain import Comparison
from terrain.discrepancy.gain import Gain
from terrain.discrepancy.nameless import Nameless
from terrain.discrepancy.noise import Noise
from terrain.discrepancy.parts import PartValues
from terrain.discrepancy.powertrain_answer import PowertrainAnswer
from terrain.discrepancy.residuals import LowPass
from terrain.discrepancy.response_slopes import Slope
from terrain.discrepancy.signals import Signals
from terrain.discrepancy.simulation import Simulation
from terrain.discrepancy.statements import Statement, session_notes
from terrain.discrepancy.terrain_match import TerrainMatch
from terrain.discrepancy.trials.scoring import Score
from terrain.discrepancy.trials.trial import Trial
from terrain.discrepancy.verdict import Diagnosis
from terrain.records import RunLog


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedRuns:
    """Runs with their diagnosis: what figures are drawn from.

    Parameters
    ----------
    diagnosis : of the runs used
    simulation, extended : before and after; ``extended`` is None where no cause was named
    terrains : on which the runs of each label were simulated
    fit, used, held_out : runs behind the diagnosis, these and those excluded from it, and those held out
    compared : fit runs beside the simulation
    held_signals : of the runs held out, faults repaired
    noise, low_pass : of the fit runs
    parts : values of the causes in parts of the data
    acting : by cause, the channels that it changes
    """

    diagnosis: Diagnosis
    simulation: Simulation
    extended: Simulation | None
    terrains: tuple[TerrainMatch, ...]
    fit: tuple[RunLog, ...]
    used: tuple[RunLog, ...]
    held_out: tuple[RunLog, ...]
    compared: tuple[ComparedRun, ...]
    held_signals: tuple[Signals, ...]
    noise: Noise
    low_pass: LowPass
    parts: tuple[PartValues, ...]
    acting: Mapping[str, Sequence[str]]


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutGain:
    """What an extension gains on held-out runs.

    Parameters
    ----------
    gain : None where it was not measured
    reason : why it was not
    comparisons : by ``filter`` and ``classifier``; None for one that does not apply
    nameless : what a nameless learner reaches on the same runs; None where none is held out
    judged : held-out runs that are fit, beside the simulation
    """

    gain: Gain | None
    reason: str | None = None
    comparisons: Mapping[str, Comparison | None] = field(default_factory=dict)
    nameless: Nameless | None = None
    judged: tuple[ComparedRun, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the gain as JSON has it."""
        nameless = {} if self.nameless is None else {"nameless": self.nameless.as_json()}
        if self.gain is None:
            return {"measured": False, "reason": self.reason, **self.comparisons, **nameless}
        return {"measured": True, **self.gain.as_json(), **self.comparisons, **nameless}


class ExtendedDescription(NamedTuple):
    """The extended description of the robot: its file, and the values of all its effects by parameter."""

    file: Path
    effects: Mapping[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Result of ``terrain explain``.

    Parameters
    ----------
    data, data_digest : name of the data set, and digest of its runs
    description, model : of the robot as it was tested; ``model`` where that is an extended one
    terrain : label of the runs that were used; None for all
    diagnosis : of the runs
    built_in : values by parameter of the effects that the simulation had before
    terrains : on which the runs of each label were simulated
    effects : names of those that may be named
    seed : of the choice of held-out runs and of the bootstrap
    used, held_out : ids of the runs behind the diagnosis, and of those held out of it
    gain : on the runs held out
    extended : None where no cause was named
    page : file
    statements : a sentence a channel
    terms : by cause, its value in quantities that the builder of the robot knows
    next_command : that simulates the next drive; None where none is suggested
    terrains_apart : measured over simulated by label, where labels clearly differ
    skipped : a sentence for each run that could not be read
    powertrain : from commanded to measured wheel speeds; None where no run logs both
    drive : of the robot, for words
    """

    data: str
    data_digest: str
    description: str
    model: str | None
    terrain: str | None
    diagnosis: Diagnosis
    built_in: Mapping[str, float]
    terrains: tuple[TerrainMatch, ...]
    effects: tuple[str, ...]
    seed: int
    used: tuple[str, ...]
    held_out: tuple[str, ...]
    gain: HeldOutGain
    extended: ExtendedDescription | None
    page: Path
    statements: tuple[Statement, ...] = ()
    terms: Mapping[str, str] = field(default_factory=dict)
    next_command: str | None = None
    terrains_apart: Mapping[str, Slope] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()
    powertrain: PowertrainAnswer | None = None
    drive: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader has to know of the terrains and sessions, in sentences."""
        return terrain_notes(self.terrains, self.terrains_apart) + session_notes(self.diagnosis)

    def as_json(self) -> dict[str, Any]:
        """Return the explanation as JSON has it."""
        return {
            "data": self.data,
            "data_digest": self.data_digest,
            **self.diagnosis.as_json(),
            "built_in": self.built_in,
            "terrain_matches": self.terrains,
            "notes": self.notes,
            "statements": [statement.as_json() for statement in self.statements],
            "terms": self.terms,
            "next_command": self.next_command,
            "effects": self.effects,
            "seed": self.seed,
            "used": self.used,
            "held_out": self.held_out,
            "gain": self.gain,
            "extended": self.extended,
            "description": self.description,
            "model": self.model,
            "terrain": self.terrain,
            "page": self.page,
            "skipped": self.skipped,
            "powertrain": self.powertrain,
        }


class Seconds(NamedTuple):
    """Duration of a diagnosis."""

    median: float
    worst: float


@dataclass(frozen=True, slots=True, eq=False)
class TrialsResult:
    """Result of ``terrain explain-trials``.

    Parameters
    ----------
    n, seed, rows, runs : as in the settings
    table : scores by name
    found_from : by robot and effect, the amplitude over the detection limit from which nine in ten are found
    seconds : that a diagnosis took
    trials : every single one
    """

    n: int
    seed: int
    rows: tuple[str, ...]
    runs: int
    table: Mapping[str, Score]
    found_from: Mapping[str, Mapping[str, float]]
    seconds: Seconds
    trials: tuple[Trial, ...]
