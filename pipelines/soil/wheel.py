"""One wheel's trials: laws compared on what is left out, then the last law in full."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from pipelines.reporting.progress import Progress
from pipelines.soil.results import (
    AXLE_ANGLE_DEG,
    BAR_RATIO,
    Checked,
    Drawn,
    HeldOut,
    LawRow,
    SoilFile,
    WheelResult,
)
from pipelines.soil.settings import FitSoilSettings
from pipelines.soil.surrogate import surrogate_predictions
from terrain.records import Array
from terrain.soil_identification.coupling import Coupling, side_coupling, without_coupling
from terrain.soil_identification.fit import LawFit, fit_law, predict
from terrain.soil_identification.held_out import (
    GIVEN,
    HELD_OUT,
    Predictor,
    held_out_predictions,
    law_predictor,
    misfit,
    regime_misfits,
    setting_misfits,
)
from terrain.soil_identification.intervals import (
    CohesionRow,
    ModulusSpread,
    Parameter,
    cohesion_profile,
    modulus_spread,
    parameters_of,
)
from terrain.soil_identification.laws import LAWS, SINKAGES, Law, Prediction
from terrain.soil_identification.plain_soil import (
    PARAMETERS,
    fit_plain_soil,
    nearly_straight,
    plain_prediction,
    plain_soil,
)
from terrain.soil_identification.trials import Trials, Wheel, setting_means

COHESIONS_PA = (0.0, 250.0, 500.0, 1000.0)
SIMULATOR_TEXT = "the law of terrain simulate: one limit, one rise, along the resultant slip"


def wheel_result(
    trials: Trials,
    further: Trials | None,
    wheel: Wheel,
    soil_file: Path,
    settings: FitSoilSettings,
    progress: Progress,
) -> tuple[WheelResult, Drawn]:
    """Return what the trials of one wheel say, and what its figures show.

    Parameters
    ----------
    trials : single ones
    further : trials that the last law predicts, fitted to all of ``trials``; None without any
    wheel : of the trials
    soil_file : where its soil is written
    settings : of the command
    progress : gets the fits that are done

    Raises
    ------
    DataError
        if there are too few settings to fit.
    """
    coupling = side_coupling(trials)
    raw, trials = trials, without_coupling(trials, coupling)
    if further is not None:
        further = without_coupling(further, coupling)
    means = setting_means(trials)
    count = _counter(trials, wheel, settings, progress)
    rows, predictions = [], {}
    for name in settings.laws:
        predictor = (
            _simulator_predictor(wheel) if name == "simulator" else law_predictor(_law(name, coupling), wheel)
        )
        predictions = _both(trials, predictor, count)
        rows.append(_law_row(name, coupling, trials, predictions))
    law = _law(settings.laws[-1], coupling)
    reference = _both(trials, surrogate_predictions, count)
    fit = fit_law(law, means, wheel)
    parameters = parameters_of(fit, means, settings.draws, settings.seed, count)
    cohesion = tuple(cohesion_profile(law, means, wheel, COHESIONS_PA))
    modulus = modulus_spread(fit, trials)
    slip, angle = (predictions[held]["load"] for held in HELD_OUT)
    result = WheelResult(
        wheel=wheel.name,
        n_trials=len(raw),
        n_settings=len(setting_means(raw)),
        load_range_n=_range(raw.load_n),
        sinkage_range_m=_range(raw.sinkage_m),
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
        soil=_soil(trials, wheel, parameters["tan_friction"].value, soil_file, settings),
    )
    return result, Drawn(wheel.name, law.name, trials, slip, angle)


def _soil(
    trials: Trials, wheel: Wheel, tan_friction: float, file: Path, settings: FitSoilSettings
) -> SoilFile:
    """Fit the simulator's law, with a friction that is given, to the trials that roll nearly straight."""
    own = nearly_straight(trials)
    fit = fit_plain_soil(
        nearly_straight(setting_means(trials)), wheel, math.atan(tan_friction), settings.draws, settings.seed
    )
    soil = plain_soil(np.array(list(fit.values.values())), file.stem)
    return SoilFile(file, fit, misfit(own, plain_prediction(soil, own, wheel)))


def _law(name: str, coupling: Coupling) -> Law:
    """Return a law, without the coupling among its parameters where the testbed's is known."""
    law = LAWS[name]
    if math.isnan(coupling.ratio):
        return law
    return law._replace(free=tuple(each for each in law.free if each != "coupling_ratio"))


def _counter(
    trials: Trials, wheel: Wheel, settings: FitSoilSettings, progress: Progress
) -> Callable[[], None]:
    """Return what reports one more fit of all that this wheel needs."""
    n_folds = sum(len(np.unique(getattr(trials, name))) for name in HELD_OUT.values())
    total = n_folds * (len(settings.laws) + 1) + settings.draws
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        progress(f"fit {wheel.name}", done, total)

    return count


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
    parameters: Mapping[str, Parameter],
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


def _range(values: Array) -> tuple[float, float]:
    return float(values.min()), float(values.max())
