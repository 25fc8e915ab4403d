"""``terrain.TerrainClassifier``: a recipe as a scikit-learn estimator of windows, which can be saved and applied."""

from __future__ import annotations

from collections.abc import Iterable
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from sklearn.base import BaseEstimator, ClassifierMixin
from sklearn.utils.validation import check_is_fitted

from features.motion import window_motion
from features.protocols import Samples
from features.recipes import WindowPipeline, make_recipe
from features.windows import WindowCut, WindowRule, labelled, overlap_of
from pipelines.learn.model_file import MANIFEST_FILE, model_info, read_model, write_model
from pipelines.learn.training_data import with_limits
from pipelines.live.assess import assess
from terrain.errors import ConfigError, DataError
from terrain.logs.schema import SIGNAL_SETS
from terrain.records import Array, Windows


class TerrainClassifier(ClassifierMixin, BaseEstimator):
    """From windows to terrain: ``fit(windows)``, ``predict(windows)``, ``save(folder)``.

    Parameters
    ----------
    recipe : name of a recipe, as ``svm``, ``trees``, ``cnn``, ``best``; or a scikit-learn classifier of features
    signal_sets : whose channels are used
    seed : deals runs into inner folds
    functions : own functions of a window, beside the features

    Attributes
    ----------
    classes_ : (k,) terrains
    model_ : :class:`~pipelines.learn.model_file.TerrainModel`, which observers, services and predictions take

    Examples
    --------
    >>> rng, run = np.random.default_rng(0), np.repeat(np.arange(6), 8)
    >>> terrain = np.where(run % 2, "ice", "mud").astype(object)
    >>> shaking = rng.normal(size=(48, 1, 200)) * np.where(run % 2, 1.0, 3.0)[:, None, None]
    >>> windows = Windows({"imu": shaking}, {"imu": ("accel_z_mps2",)}, {"imu": 100.0}, 2.0,
    ...                   2.0 * np.arange(48), run.astype(str).astype(object), terrain)
    >>> model = TerrainClassifier("svm").fit(windows)
    >>> model.predict(windows[:2])
    array(['mud', 'mud'], dtype=object)
    >>> model.score(windows, terrain)
    1.0
    """

    def __init__(
        self,
        recipe: Any = "svm",
        signal_sets: tuple[str, ...] = SIGNAL_SETS,
        seed: int = 0,
        functions: tuple[Any, ...] = (),
    ) -> None:
        self.recipe = recipe
        self.signal_sets = signal_sets
        self.seed = seed
        self.functions = functions

    def unfitted(self, gap: int) -> WindowPipeline:
        """Return the recipe, where so many windows on either side of one may share samples with it."""
        return make_recipe(self.recipe, self.signal_sets, gap=gap, seed=self.seed, functions=self.functions)

    def fit(self, X: Windows, y: Array | None = None) -> Self:
        """Fit the recipe and what it knows of its own limits; inner folds are made of whole runs.

        Parameters
        ----------
        X : labelled windows; those without a label are left out
        y : (n,) terrain of each window in place of its label

        Raises
        ------
        DataError
            if no window has a label, there is one terrain only, or there are too few windows of one.
        """
        windows = _windows(X)
        terrain = np.array([name or "" for name in (windows.terrain if y is None else y)], dtype=object)
        if len(terrain) != len(windows):
            raise DataError(f"{len(terrain)} terrains for {len(windows)} windows")
        windows = labelled(WindowCut(replace(windows, terrain=terrain), {})).windows
        gap = overlap_of(windows)
        recipe = self.unfitted(gap)
        samples = Samples(windows, {}, windows.groups, gap)
        recipe.fit(windows, samples.terrain)
        info = model_info(
            recipe[0].layout_,
            WindowRule(windows.length_s, None, None),
            samples.terrain,
            run_digests=(),
            recipe=self.recipe if isinstance(self.recipe, str) else type(self.recipe).__name__,
            signal_sets=tuple(self.signal_sets),
            seed=self.seed,
        )
        features, motion = recipe[0].features_of(windows), window_motion(windows)
        self.model_, _ = with_limits(recipe, info, samples, features, motion)
        self.classes_ = np.asarray(recipe.classes_, dtype=object)
        return self

    def predict(self, X: Windows) -> Array:
        """Return the most probable terrain (n,) of each window.

        Raises
        ------
        DataError
            if the windows lack a channel, or have another length or rate.
        """
        best = self.predict_proba(X).argmax(axis=1)
        return np.asarray(self.classes_[best], dtype=object)

    def predict_proba(self, X: Windows) -> Array:
        """Return calibrated probabilities (n, k) in the order of ``classes_``; errors as :meth:`predict`."""
        check_is_fitted(self, "model_")
        return assess(self.model_, _windows(X)).probability

    def adapt(self, X: Windows, terrain: str = "") -> Self:
        """Return the classifier for a session, by some of its windows; ``model_.adaptation.found`` says what was found.

        Parameters
        ----------
        X : windows of the session, 5 s of it at least, 20 s are good
        terrain : that all of them are on; where it is not named, they say less

        Raises
        ------
        ConfigError
            if the terrain was not learned.
        DataError
            if the windows are too few or lack a channel, or the training windows had nothing to adapt by.
        """
        check_is_fitted(self, "model_")
        adapted = copy(self)
        adapted.model_ = self.model_.adapt(_windows(X), terrain)
        return adapted

    def predictions(self, X: Windows) -> pd.DataFrame:
        """Return a row a window: run, start, terrain, and the probability of each terrain."""
        probability = self.predict_proba(X)
        head = {
            "run_id": X.run_id,
            "start_s": X.start_s,
            "terrain": self.classes_[probability.argmax(axis=1)],
        }
        return pd.DataFrame(head | dict(zip(self.classes_.tolist(), probability.T, strict=True)))

    def save(self, folder: str | Path) -> Path:
        """Write the model into a folder, which ``load`` and all commands read; return the folder.

        Raises
        ------
        ConfigError
            if the folder holds something else than a model.
        ModelError
            if estimator or functions cannot be found again by the name of a module.
        """
        check_is_fitted(self, "model_")
        place = Path(folder)
        if place.exists() and (
            not place.is_dir() or (any(place.iterdir()) and not (place / MANIFEST_FILE).is_file())
        ):
            raise ConfigError(f"{place}: holds something else than a model; choose another folder")
        place.mkdir(parents=True, exist_ok=True)
        write_model(place, self.model_)
        return place

    @classmethod
    def load(cls, source: str | Path, trust: Iterable[str] = ()) -> Self:
        """Return a fitted classifier of a folder, or of a registered model by its URI.

        Parameters
        ----------
        source : folder or URI
        trust : modules of one's own that the model may run, beside those that ``--trust`` has remembered

        Raises
        ------
        ModelError
            if there is no such model, it is damaged or foreign, or needs a module that is not trusted.
        """
        model = read_model(source, trust)
        signal_sets, functions = tuple(model.info.signal_sets), getattr(model.recipe[0], "functions", ())
        found = cls(model.info.recipe, signal_sets or SIGNAL_SETS, model.info.seed, tuple(functions))
        found.model_ = model
        found.classes_ = np.asarray(model.recipe.classes_, dtype=object)
        return found


def _windows(given: Any) -> Windows:
    if not isinstance(given, Windows):
        raise DataError(
            f"windows are needed, as terrain.cut_windows gives them; this is a {type(given).__name__}"
        )
    return given
