"""``terrain crossval`` on a store of features: the same figures, without reading the runs."""

from __future__ import annotations

from dataclasses import replace

from pipelines.crossval.crossval import report_of
from pipelines.crossval.evaluation import fit_folds, pool, sets_of, summarise
from pipelines.crossval.extras import examples_of
from pipelines.crossval.results import CrossvalReport
from pipelines.crossval.settings import SPEED_PROTOCOLS, CrossvalSettings
from pipelines.crossval.splits import folds_of
from pipelines.feature_store.store import FeatureStore, read_store
from pipelines.reporting.progress import Progress, silent
from terrain.errors import ConfigError

NO_EXTRAS = (
    "from a store of features: speed alone, slow against fast and the learning curve need the runs themselves"
)
NO_SUPPORT = "support: a store of features does not hold how the robot moved"


def crossval_store(
    store: FeatureStore, settings: CrossvalSettings, progress: Progress = silent
) -> CrossvalReport:
    """Cross-validate a recipe on the labelled windows of a store; its figures are those of its runs.

    Raises
    ------
    ConfigError
        if the protocol cuts windows of its own.
    LogError, DataError
        as :func:`pipelines.feature_store.store.read_store` and :func:`pipelines.crossval.splits.folds_of`.
    """
    if settings.protocol == "published":
        raise ConfigError("'published' cuts windows of its own: it needs runs, not a store of features")
    if settings.recipe != "svm":
        raise ConfigError(f"recipe {settings.recipe!r} needs the samples of runs, not a store of features")
    if settings.protocol in SPEED_PROTOCOLS:
        raise ConfigError(f"{settings.protocol!r} needs the speeds of runs, not a store of features")
    samples, features = read_store(store, progress)
    folds = folds_of(samples, settings.protocol, settings.n_repeats, settings.seed)
    examples = examples_of(features, samples)
    classifier = settings.new_recipe()[-1]
    results = fit_folds(classifier, examples, folds, settings.jobs, settings.protocol, progress)
    held_out = pool(results, examples.terrain)
    figures = summarise(held_out, samples, settings.seed)
    report = report_of(figures, samples, settings, features.shape[1], store.repaired, None)
    report = replace(report, conformal=sets_of(held_out, samples, settings.seed))
    return replace(report, notes=(*report.notes, NO_SUPPORT, *((NO_EXTRAS,) if settings.extras else ())))
