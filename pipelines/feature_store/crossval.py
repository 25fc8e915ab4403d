"""``terrain crossval`` on a store of features: the same figures, without reading the runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pipelines.crossval.crossval import report_of, with_limits
from pipelines.crossval.evaluation import fit_folds, pool, summarise
from pipelines.crossval.extras import examples_of
from pipelines.crossval.results import CrossvalReport
from pipelines.crossval.settings import FEATURE_RECIPE, SPEED_PROTOCOLS, CrossvalSettings, RecipeSettings
from pipelines.crossval.splits import folds_of
from pipelines.crossval.unknown import leave_terrain_out
from pipelines.feature_store.store import FeatureStore, Stored, read_store
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError

NO_EXTRAS = (
    "from a store of features: speed alone, slow against fast, the learning curve and courses need the runs "
    "themselves"
)


def refuse_recipe(settings: RecipeSettings) -> None:
    """Raise ``ConfigError`` where a recipe learns from samples, which a store does not hold."""
    if settings.recipe != FEATURE_RECIPE:
        raise ConfigError(f"recipe {settings.recipe!r} needs the samples of runs, not a store of features")


def crossval_store(
    store: FeatureStore, settings: CrossvalSettings, progress: Progress = silent
) -> CrossvalReport:
    """Cross-validate a recipe on the labelled windows of a store; its figures are those of its runs.

    Raises
    ------
    ConfigError
        if the protocol cuts windows of its own, or the recipe or the protocol needs samples.
    LogError, DataError
        as :func:`pipelines.feature_store.store.read_store` and :func:`pipelines.crossval.splits.folds_of`.
    """
    refuse_recipe(settings)
    if settings.protocol == "published":
        raise ConfigError("'published' cuts windows of its own: it needs runs, not a store of features")
    if settings.protocol in SPEED_PROTOCOLS:
        raise ConfigError(f"{settings.protocol!r} needs the wheel speeds of runs, not a store of features")
    return crossval_stored(read_store(store, progress), settings, store.repaired, progress)


def crossval_stored(
    stored: Stored, settings: CrossvalSettings, repaired: Mapping[str, int], progress: Progress = silent
) -> CrossvalReport:
    """Cross-validate the SVM on windows that were read from a store.

    Parameters
    ----------
    stored : labelled windows with their features and motion
    settings : of a protocol that needs no samples
    repaired : what a repairing reader dropped when the store was made, as counts by kind
    progress : called as folds are done

    Raises
    ------
    DataError
        as :func:`pipelines.crossval.splits.folds_of`.
    """
    samples, features, motion = stored
    folds = folds_of(samples, settings.protocol, settings.n_repeats, settings.seed)
    examples = examples_of(features, samples)
    classifier = settings.new_recipe()[-1]
    results = fit_folds(classifier, examples, folds, settings.jobs, settings.protocol, progress)
    held_out = pool(results, examples.terrain)
    figures = summarise(held_out, samples, settings.seed)
    report = report_of(figures, samples, settings, features.shape[1], repaired, None)
    report = with_limits(report, held_out, samples, motion)
    if settings.protocol == "leave-terrain-out":
        unknown = leave_terrain_out(examples, samples, settings.seed, settings.jobs, progress)
        report = replace(report, unknown=unknown)
    if settings.extras and settings.protocol == "grouped":
        report = replace(report, notes=(*report.notes, NO_EXTRAS))
    return report
