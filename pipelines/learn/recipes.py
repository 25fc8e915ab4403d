"""Recipes by the options of a command, and what a text names in a module of one's own."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from features.recipes import WindowPipeline, make_recipe
from pipelines.learn.settings import FEATURE_RECIPE, WITHOUT_SVM, LearnSettings
from terrain.classify.svm import Candidate
from terrain.errors import ConfigError


def recipe_of(settings: LearnSettings, text: str = FEATURE_RECIPE) -> WindowPipeline:
    """Return the unfitted recipe that a text names, with the options of a command.

    Parameters
    ----------
    settings : signal sets, seed, own features and hyper-parameters
    text : name of a recipe, or ``MODULE:NAME`` of one's own; after ``@`` its signal sets, by commas

    Raises
    ------
    ConfigError
        as :func:`make_recipe` and :func:`load_named`.
    """
    name, separator, sets = text.partition("@")
    options: dict[str, Any] = {}
    if ":" in name or settings.feature:
        options["functions"] = [load_named(each) for each in settings.feature]
    if settings.params is not None and name not in WITHOUT_SVM:
        from pipelines.learn.search import read_params

        options["candidates"] = (Candidate(*read_params(settings.params)),)
    return make_recipe(
        load_named(name) if ":" in name else name,
        tuple(part.strip() for part in sets.split(",")) if separator else settings.signal_sets,
        gap=settings.rule.overlap,
        seed=settings.seed,
        **options,
    )


def load_named(text: str) -> Any:
    """Return what ``MODULE:NAME`` names; modules of the current folder are found too.

    Raises
    ------
    ConfigError
        if the module cannot be imported, or has no such name.

    Examples
    --------
    >>> load_named("math:sqrt")(4.0)
    2.0
    >>> load_named("math:squirt")
    Traceback (most recent call last):
    terrain.errors.ConfigError: math:squirt: module 'math' has no 'squirt'
    """
    module_name, _, name = text.partition(":")
    folder = str(Path.cwd())
    if folder not in sys.path:
        sys.path.append(folder)  # last, so that a file of the folder hides no library
    try:
        module = importlib.import_module(module_name)
    except Exception as error:
        raise ConfigError(f"{text}: module {module_name!r} cannot be imported: {error}") from error
    found = getattr(module, name, None)
    if not callable(found) and not hasattr(found, "fit"):
        raise ConfigError(f"{text}: module {module_name!r} has no {name!r}")
    return found
