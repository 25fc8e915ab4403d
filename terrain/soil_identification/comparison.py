"""Laws of a wheel in sand, compared on slips and slip angles that their fits did not have; the last one in full.

For reference, a polynomial of slip and angle shows how well a fit without any mechanics predicts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from terrain.identify import folds
from terrain.records import Array
from terrain.soil_identification.fit import (
    LAWS,
    SINKAGES,
    CohesionRow,
    Law,
    LawFit,
    ModulusSpread,
    Prediction,
    SoilParameter,
    cohesion_profile,
    fit_law,
    modulus_spread,
    parameters_of,
    predict,
)
from terrain.soil_identification.plain_soil import (
    PARAMETERS,
    PlainFit,
    fit_plain_soil,
    nearly_straight,
    plain_prediction,
    plain_soil,
)
from terrain.soil_identification.trials import (
    Coupling,
    Trials,
    Wheel,
    setting_means,
    side_coupling,
    without_coupling,
)

HELD_OUT = {"slip": "slip_setting", "angle": "angle_setting"}
"""What is held out in turn: all trials of one commanded wheel speed, or of one slip angle."""

GIVEN = ("load", "sinkage")

REGIMES: dict[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "skidding, 0 to 30 deg": ((-1.1, -0.1), (0.0, 31.0)),
    "skidding, 45 to 75 deg": ((-1.1, -0.1), (31.0, 76.0)),
    "skidding, 90 deg": ((-1.1, -0.1), (76.0, 91.0)),
    "rolling, 0 to 30 deg": ((-0.1, 0.1), (0.0, 31.0)),
    "rolling, 45 to 75 deg": ((-0.1, 0.1), (31.0, 76.0)),
    "rolling, 90 deg": ((-0.1, 0.1), (76.0, 91.0)),
    "driving, 0 to 30 deg": ((0.1, 1.1), (0.0, 31.0)),
    "driving, 45 to 75 deg": ((0.1, 1.1), (31.0, 76.0)),
    "driving, 90 deg": ((0.1, 1.1), (76.0, 91.0)),
}
"""Ranges of slip and of the slip angle's size in degrees, by which misfits are shown."""


class Misfit(NamedTuple):
    """Root mean square errors: of both forces over the load, and of the sinkage in m; NaN of no trial."""

    n_trials: int
    pull_ratio: float
    side_ratio: float
    sinkage_m: float

    @property
    def forces(self) -> str:
        """The errors of traction and side force, in words."""
        return f"{100.0 * self.pull_ratio:.1f} % and {100.0 * self.side_ratio:.1f} %"


Predictor = Callable[[Trials, Trials], dict[str, Prediction]]
"""From training trials (means of settings) and tested trials to predictions by what is given."""


def law_predictor(law: Law, wheel: Wheel) -> Predictor:
    """Return what fits a law to the first trials and predicts the second, by each of :data:`GIVEN`."""

    def predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
        fit = fit_law(law, training, wheel)
        return {given: predict(fit, tested, given) for given in GIVEN}

    return predictions


def held_out_predictions(
    trials: Trials, predictor: Predictor, held_out: str, on_fold: Callable[[], None] = lambda: None
) -> dict[str, Prediction]:
    """Return predictions of all trials, each by a fit without its slip or its angle.

    Parameters
    ----------
    trials : single ones
    predictor : fits and predicts
    held_out : ``slip`` or ``angle``
    on_fold : called after each fit

    Raises
    ------
    DataError
        if too few settings are left to fit.
    """
    found: dict[str, list[Array]] = {}
    for training, tested in folds(getattr(trials, HELD_OUT[held_out])):
        for given, part in predictor(setting_means(trials.chosen(training)), trials.chosen(tested)).items():
            whole = found.setdefault(given, [np.full(len(trials), np.nan) for _ in part])
            for all_trials, these in zip(whole, part, strict=True):
                all_trials[tested] = these
        on_fold()
    return {given: Prediction(*whole) for given, whole in found.items()}


def misfit(trials: Trials, prediction: Prediction, rows: Array | None = None) -> Misfit:
    """Return the errors of a prediction of trials, or of those of a mask (n,)."""
    rows = np.ones(len(trials), dtype=bool) if rows is None else rows
    if not rows.any():
        return Misfit(0, np.nan, np.nan, np.nan)
    errors = (
        (prediction.pull_n - trials.pull_n) / trials.load_n,
        (prediction.side_n - trials.side_n) / trials.load_n,
        prediction.sinkage_m - trials.sinkage_m,
    )
    pull, side, sinkage = (float(np.sqrt(np.mean(error[rows] ** 2))) for error in errors)
    return Misfit(int(rows.sum()), pull, side, sinkage)


def regime_misfits(trials: Trials, prediction: Prediction) -> dict[str, Misfit]:
    """Return the errors by :data:`REGIMES`, of those that have trials."""
    angle = np.abs(trials.angle_setting)
    rows = {
        name: (trials.slip_ratio >= slow) & (trials.slip_ratio < fast) & (angle >= straight) & (angle < aside)
        for name, ((slow, fast), (straight, aside)) in REGIMES.items()
    }
    return {name: misfit(trials, prediction, mask) for name, mask in rows.items() if mask.any()}


def setting_misfits(trials: Trials, prediction: Prediction, held_out: str) -> dict[float, Misfit]:
    """Return the errors by the setting that was held out."""
    setting = getattr(trials, HELD_OUT[held_out])
    return {
        float(value): misfit(trials, prediction, setting == value) for value in np.unique(setting).tolist()
    }


DEGREE = 4


def polynomial_predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
    """Return forces over the load and sinkage by ridge regression on a polynomial of slip and angle.

    The strength of the ridge is chosen by leave-one-out on the training part.
    """
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    targets = np.column_stack(
        [training.pull_n / training.load_n, training.side_n / training.load_n, training.sinkage_m * 10.0]
    )
    model = make_pipeline(
        StandardScaler(),
        PolynomialFeatures(DEGREE),
        StandardScaler(),
        RidgeCV(alphas=np.logspace(-4, 3, 29), alpha_per_target=True),
    )
    slips, tested_slips = (
        np.column_stack([own.slip_ratio, own.slip_angle_rad]) for own in (training, tested)
    )
    pull, side, depth = model.fit(slips, targets).predict(tested_slips).T
    unknown = np.full(len(tested), np.nan)
    return {"load": Prediction(pull * tested.load_n, side * tested.load_n, depth / 10.0, unknown)}


BAR_RATIO = 0.15
"""Root mean square error of each force over the load, on slips or angles left out, that is aimed at."""

AXLE_ANGLE_DEG = 89.0
"""From here on a wheel is dragged along its axle, and stands deeper than its axle."""

COHESIONS_PA = (0.0, 250.0, 500.0, 1000.0)
SIMULATOR_TEXT = "the law of terrain simulate: one limit, one rise, along the resultant slip"


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
    file : that was written; None without ``--out``
    fit : of the simulator's law to trials that roll nearly straight, with the friction of the last law
    misfit : of that law on those trials
    """

    file: Path | None
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
    parameters: Mapping[str, SoilParameter]
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

    @property
    def verdict(self) -> str:
        """Whether the last law reaches what is aimed at, and where it stops, in words."""
        parts = []
        for held, found in (("slips", self.laws[-1].slip), ("angles", self.laws[-1].angle)):
            without = f"({found.below_axle_angle.forces} without the wheel dragged along its axle)"
            state = "reached" if found.reached else f"not reached {without}"
            parts.append(
                f"{held} left out, traction and side force off by {found.load.forces} of the load: {state}"
            )
        if self.checked is not None:
            parts.append(f"{self.checked.load.n_trials} further trials: {self.checked.load.forces}")
        return f"{self.wheel}: {100.0 * BAR_RATIO:.0f} % aimed at; {'; '.join(parts)}."


def compare_laws(
    trials: Trials,
    further: Trials | None,
    wheel: Wheel,
    laws: Sequence[str],
    draws: int,
    seed: int,
    progress: Callable[[str, int, int], None] = lambda task, done, total: None,
) -> tuple[WheelResult, Trials, dict[str, Prediction]]:
    """Compare laws on slips and on angles that their fits did not have, and report the last one in full.

    Parameters
    ----------
    trials : single ones of one wheel
    further : trials that the last law predicts, fitted to all of ``trials``; None without any
    wheel : of the trials
    laws : names of :data:`~terrain.soil_identification.fit.LAWS`, and ``simulator``
    draws, seed : of the bootstrap over settings
    progress : gets the task, how many fits are done, and how many there are

    Returns
    -------
    result
    trials
        with the traction corrected, without those that show the testbed's coupling
    predictions
        of these trials by the last law, by what was left out

    Raises
    ------
    DataError
        if there are too few settings to fit.
    """
    fits, total = itertools.count(1), n_fits(trials, laws, draws)

    def count() -> None:
        progress(f"fit {wheel.name}", next(fits), total)

    coupling = side_coupling(trials)
    raw, trials = trials, without_coupling(trials, coupling)
    if further is not None:
        further = without_coupling(further, coupling)
    means = setting_means(trials)
    rows, predictions = [], {}
    for name in laws:
        predictor = (
            _simulator_predictor(wheel) if name == "simulator" else law_predictor(_law(name, coupling), wheel)
        )
        predictions = _both(trials, predictor, count)
        rows.append(_law_row(name, coupling, trials, predictions))
    law = _law(laws[-1], coupling)
    reference = _both(trials, polynomial_predictions, count)
    fit = fit_law(law, means, wheel)
    parameters = parameters_of(fit, means, draws, seed, count)
    cohesion = tuple(cohesion_profile(law, means, wheel, COHESIONS_PA))
    modulus = modulus_spread(fit, trials)
    slip, angle = (predictions[held]["load"] for held in HELD_OUT)
    result = WheelResult(
        wheel=wheel.name,
        n_trials=len(raw),
        n_settings=len(setting_means(raw)),
        load_range_n=(float(raw.load_n.min()), float(raw.load_n.max())),
        sinkage_range_m=(float(raw.sinkage_m.min()), float(raw.sinkage_m.max())),
        coupling=coupling,
        deeper_than_axle=int((raw.sinkage_m > wheel.tip_radius_m).sum()),
        laws=tuple(rows),
        law=law.name,
        parameters=parameters,
        by_slip=setting_misfits(trials, slip, "slip"),
        by_angle=setting_misfits(trials, angle, "angle"),
        regimes=regime_misfits(trials, slip),
        cohesion=cohesion,
        modulus=modulus,
        surrogate_slip=misfit(trials, reference["slip"]["load"]),
        surrogate_angle=misfit(trials, reference["angle"]["load"]),
        checked=None if further is None else _checked(fit, further),
        not_identified=tuple(_not_identified(parameters, cohesion, modulus, coupling)),
        soil=_soil(trials, wheel, parameters["tan_friction"].value, draws, seed),
    )
    return result, trials, {"slip": slip, "angle": angle}


def n_fits(trials: Trials, laws: Sequence[str], draws: int) -> int:
    """Return how many fits :func:`compare_laws` makes."""
    n_folds = sum(len(np.unique(getattr(trials, name))) for name in HELD_OUT.values())
    return n_folds * (len(laws) + 1) + draws


def _soil(trials: Trials, wheel: Wheel, tan_friction: float, draws: int, seed: int) -> SoilFile:
    """Fit the simulator's law, with a friction that is given, to the trials that roll nearly straight."""
    own = nearly_straight(trials)
    fit = fit_plain_soil(nearly_straight(setting_means(trials)), wheel, math.atan(tan_friction), draws, seed)
    soil = plain_soil(np.array(list(fit.values.values())), "fit")
    return SoilFile(None, fit, misfit(own, plain_prediction(soil, own, wheel)))


def _law(name: str, coupling: Coupling) -> Law:
    """Return a law, without the coupling among its parameters where the testbed's is known."""
    law = LAWS[name]
    if math.isnan(coupling.ratio):
        return law
    return law._replace(free=tuple(each for each in law.free if each != "coupling_ratio"))


def _both(
    trials: Trials, predictor: Predictor, count: Callable[[], None]
) -> dict[str, dict[str, Prediction]]:
    return {held: held_out_predictions(trials, predictor, held, count) for held in HELD_OUT}


def _simulator_predictor(wheel: Wheel) -> Predictor:
    """Return what fits the simulator's law to all training trials; it takes no sinkage."""

    def predictions(training: Trials, tested: Trials) -> dict[str, Prediction]:
        values = np.array(list(fit_plain_soil(training, wheel).values.values()))
        found = plain_prediction(plain_soil(values, "fit"), tested, wheel)
        return {"load": found, "sinkage": Prediction(*(np.full(len(tested), np.nan) for _ in found))}

    return predictions


def _law_row(
    name: str, coupling: Coupling, trials: Trials, predictions: Mapping[str, Mapping[str, Prediction]]
) -> LawRow:
    straight = np.abs(trials.angle_setting) < AXLE_ANGLE_DEG
    found = {}
    for held, given in predictions.items():
        by_load = misfit(trials, given["load"])
        reached = max(by_load.pull_ratio, by_load.side_ratio) <= BAR_RATIO
        below = misfit(trials, given["load"], straight)
        found[held] = HeldOut(by_load, misfit(trials, given["sinkage"]), below, reached)
    if name == "simulator":
        return LawRow(name, SIMULATOR_TEXT, len(PARAMETERS), found["slip"], found["angle"])
    law = _law(name, coupling)
    n_parameters = len(law.free) + len(SINKAGES[law.sinkage])
    return LawRow(name, law.text, n_parameters, found["slip"], found["angle"])


def _checked(fit: LawFit, further: Trials) -> Checked:
    return Checked(*(misfit(further, predict(fit, further, given)) for given in GIVEN))


def _not_identified(
    parameters: Mapping[str, SoilParameter],
    cohesion: Sequence[CohesionRow],
    modulus: ModulusSpread,
    coupling: Coupling,
) -> list[str]:
    unknown = [name for name, parameter in parameters.items() if not parameter.identified]
    first, last = cohesion[0], cohesion[-1]
    with_it, without = (math.degrees(row.friction_angle_rad) for row in (last, first))
    sentences = [
        f"Cohesion against friction: with {last.cohesion_pa:.0f} Pa in place of 0 the friction angle is "
        f"{with_it:.1f} in place of {without:.1f} degrees, and the sum of squares {2 * last.cost:.1f} in "
        f"place of {2 * first.cost:.1f}.",
        "kc, kphi and n: there is one wheel width and one dead weight. The pressure at a depth of one wheel "
        f"width that carries the measured load is {modulus.rolling_pa / 1e3:.0f} kPa when rolling straight "
        f"and {modulus.smallest_pa / 1e3:.1f} to {modulus.largest_pa / 1e3:.0f} kPa over nine tenths of all "
        "trials: it goes with how the wheel travels.",
        "How sinkage depends on the load: all trials have one dead weight, and their measured loads differ "
        "by what the guide takes, not by what was put on.",
    ]
    if math.isnan(coupling.ratio):
        sentences.append(
            "What the testbed adds to the traction of its side force: there are no trials of a locked wheel "
            "along its axle."
        )
    if unknown:
        sentences.append(f"Narrowed to no less than half of the prior, or at a bound: {', '.join(unknown)}.")
    return sentences
