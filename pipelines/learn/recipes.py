"""Recipes by the options of a command, hyper-parameters of a file, and what a text names in a module of one's own."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from features.recipes import WindowPipeline, make_recipe
from pipelines.learn.settings import FEATURE_RECIPE, WITHOUT_SVM, LearnSettings
from pipelines.learn.trust import place_of
from terrain.classify.svm import Candidate
from terrain.errors import ConfigError
from terrain.files.documents import MAX_JSON_BYTES, parse_document
from terrain.files.names import printable, read_regular


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
    options: dict[str, Any] = {"functions": [load_named(each) for each in settings.feature]}
    if settings.params is not None and name not in WITHOUT_SVM:
        options["candidates"] = (read_params(settings.params),)
    return make_recipe(
        load_named(name) if ":" in name else name,
        tuple(part.strip() for part in sets.split(",")) if separator else settings.signal_sets,
        gap=settings.rule.overlap,
        seed=settings.seed,
        **options,
    )


class BestFile(BaseModel):
    """What ``--params`` reads of the file of a search."""

    model_config = ConfigDict(extra="ignore")

    version: Literal[1]
    params: Candidate


def read_params(file: Path) -> Candidate:
    """Return the hyper-parameters of a file that a search wrote.

    Raises
    ------
    ConfigError
        if it is no such file, of another version, or has an unknown or impossible hyper-parameter.
    """
    content = read_regular(file, str(file), ConfigError, MAX_JSON_BYTES)
    try:
        return parse_document(content, BestFile).params
    except ValueError as error:
        raise ConfigError(f"{file}: is no result of a search ({printable(str(error))[:200]})") from None


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
    try:
        place_of(module_name.partition(".")[0])
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as error:  # a script ends itself
        raise ConfigError(f"{text}: module {module_name!r} cannot be imported: {error}") from error
    found = getattr(module, name, None)
    if not callable(found) and not hasattr(found, "fit"):
        raise ConfigError(f"{text}: module {module_name!r} has no {name!r}")
    return found
