"""What ``terrain fit-soil`` finds of each wheel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from terrain.soil_identification.coupling import Coupling
from terrain.soil_identification.held_out import Misfit
from terrain.soil_identification.intervals import CohesionRow, ModulusSpread, Parameter
from terrain.soil_identification.laws import Prediction
from terrain.soil_identification.plain_soil import PlainFit
from terrain.soil_identification.trials import Trials

BAR_RATIO = 0.15
"""Root mean square error of each force over the load, on slips or angles left out, that is aimed at."""

AXLE_ANGLE_DEG = 89.0
"""From here on a wheel is dragged along its axle, and stands deeper than its axle."""


class HeldOut(NamedTuple):
    """Errors of predictions with the slip, or the angle, of each trial left out of the fit.

    Parameters
    ----------
    load : sinkage predicted, from slip, angle and load alone
    sinkage : sinkage measured
    below_axle_angle : of ``load``, trials but those dragged along the axle
    reached : whether both forces of ``load`` are within :data:`BAR_RATIO`
    """

    load: Misfit
    sinkage: Misfit
    below_axle_angle: Misfit
    reached: bool


class LawRow(NamedTuple):
    """A law by its errors on slips and on angles that were left out."""

    name: str
    text: str
    n_parameters: int
    slip: HeldOut
    angle: HeldOut


class Checked(NamedTuple):
    """Errors of the last law, fitted to all trials, on further ones: sinkage predicted, and measured."""

    load: Misfit
    sinkage: Misfit


class SoilFile(NamedTuple):
    """The soil that the simulator takes.

    Parameters
    ----------
    file : that was written
    fit : of the simulator's law to trials that roll nearly straight, with the friction of the last law
    misfit : of that law on those trials
    """

    file: Path
    fit: PlainFit
    misfit: Misfit


@dataclass(frozen=True, slots=True)
class WheelResult:
    """One wheel.

    Parameters
    ----------
    wheel, n_trials, n_settings : which, and how much of it
    load_range_n, sinkage_range_m : smallest and largest mean of a trial
    coupling : of the testbed, by which the measured traction is corrected; its trials are judged nowhere
    deeper_than_axle : number of trials whose sinkage is over the wheel's radius
    laws : compared, in the order in which they were asked for
    law : the last one, whose figures follow
    parameters : by name
    by_slip, by_angle : errors by the commanded wheel speed in mm/s, and the slip angle in degrees, left out
    regimes : errors by regime, slips left out and load given
    cohesion : what friction goes with a cohesion that is given
    modulus : of the soil, as it seems from each trial
    surrogate_slip, surrogate_angle : errors of a polynomial of slip and angle, for reference
    checked : on the trials of ``--check``; None without any
    not_identified : a sentence for each thing that these trials cannot say
    soil : that was written for the simulator
    """

    wheel: str
    n_trials: int
    n_settings: int
    load_range_n: tuple[float, float]
    sinkage_range_m: tuple[float, float]
    coupling: Coupling
    deeper_than_axle: int
    laws: tuple[LawRow, ...]
    law: str
    parameters: Mapping[str, Parameter]
    by_slip: Mapping[float, Misfit]
    by_angle: Mapping[float, Misfit]
    regimes: Mapping[str, Misfit]
    cohesion: tuple[CohesionRow, ...]
    modulus: ModulusSpread
    surrogate_slip: Misfit
    surrogate_angle: Misfit
    checked: Checked | None
    not_identified: tuple[str, ...]
    soil: SoilFile


@dataclass(frozen=True, slots=True)
class FitSoilResult:
    """What ``terrain fit-soil`` found.

    Parameters
    ----------
    out, dataset, data_digest, seed, draws : what it was made of, and where it is
    bar_ratio : :data:`BAR_RATIO`
    wheels : one each
    files : that were written
    skipped : a sentence for each trial that was skipped
    """

    out: Path
    dataset: str
    data_digest: str
    seed: int
    draws: int
    bar_ratio: float
    wheels: tuple[WheelResult, ...]
    files: tuple[str, ...]
    skipped: tuple[str, ...]


class Drawn(NamedTuple):
    """What figures of a wheel show: trials, and predictions with slips, and with angles, left out."""

    wheel: str
    law: str
    trials: Trials
    slip: Prediction
    angle: Prediction
