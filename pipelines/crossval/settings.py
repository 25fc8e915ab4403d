"""Settings of a recipe, and of its cross-validation."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self, get_args

from pydantic import field_validator, model_validator

from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS

if TYPE_CHECKING:
    from features.windows import WindowRule
    from pipelines.learn.recipes import WindowPipeline

Protocol = Literal[
    "grouped",
    "leave-one-run-out",
    "leave-sessions-out",
    "leave-regimes-out",
    "leave-terrain-out",
    "published",
    "slow-fast",
    "fast-slow",
]
PROTOCOLS: tuple[str, ...] = get_args(Protocol)
SPEED_PROTOCOLS = ("slow-fast", "fast-slow")
Recipe = Literal["svm", "cnn", "stack", "best", "response"]
RECIPES: tuple[str, ...] = get_args(Recipe)
FEATURE_RECIPE = "svm"
"""The recipe that learns from features alone, and so from a store of them."""

WINDOW_S = 2.0
PUBLISHED_WINDOW_S = 1.7


class RecipeSettings(Settings):
    """A recipe, how its windows are cut, and how it is evaluated."""

    recipe: Recipe = setting(
        "svm", "SVM on features, network, both joined, the best of them, or responses of wheels."
    )
    window_s: float | None = setting(None, "Window length in s (2; 1.7 under 'published').", "--window")
    stride_s: float | None = setting(None, "From window to window in s; one length by default.", "--stride")
    steady: bool = setting(True, "Keep windows of steady motion only.")
    signal_sets: tuple[str, ...] = setting(
        SIGNAL_SETS,
        "Signal sets to use, by commas; leave one out to see what it is worth.",
        option="--signals",
        separated=True,
    )
    repeats: int | None = setting(None, "Fold assignments (5).", ge=1)
    seed: int = setting(0, "Deals runs into folds.", ge=0)
    n_jobs: int = setting(0, "Processes at once; 0 for one a core.", "--jobs", ge=0)
    merge_duplicates: bool = setting(
        False, "Treat runs that hold the same measurements as one run instead of refusing them."
    )
    params: Path | None = setting(None, "Result of terrain sweep, in place of the SVM's own choice.")
    skip_short: bool = setting(False, "Leave out and count runs shorter than a window.", option="")

    @model_validator(mode="after")
    def _check_signal_sets(self) -> Self:
        if not self.signal_sets:
            raise ConfigError(f"no signal set is named; there are {','.join(SIGNAL_SETS)}")
        if self.params is not None and self.recipe in ("cnn", "response"):
            raise ConfigError(
                f"--params has hyper-parameters of the SVM, which {self.recipe!r} does not have"
            )
        for name in self.signal_sets:
            if name not in SIGNAL_SETS:
                raise ConfigError(f"unknown signal set {name!r}; there are {', '.join(SIGNAL_SETS)}")
        return self

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        return _rule(self, WINDOW_S)

    @property
    def jobs(self) -> int:
        """Processes at once: what was asked for, or one a core."""
        return self.n_jobs if self.n_jobs > 0 else os.cpu_count() or 1

    def shared(self) -> dict[str, Any]:
        """Return the fields that evaluation and training have in common, by name."""
        return {name: getattr(self, name) for name in RecipeSettings.model_fields}

    def new_recipe(self) -> WindowPipeline:
        """Return the recipe, unfitted."""
        from pipelines.learn.params import read_params
        from pipelines.learn.recipes import make_recipe
        from terrain.classify.svm import CANDIDATES

        candidates = CANDIDATES if self.params is None else (read_params(self.params),)
        return make_recipe(
            self.recipe, self.signal_sets, gap=self.rule.overlap, seed=self.seed, candidates=candidates
        )


class CrossvalSettings(RecipeSettings):
    """What is evaluated, and by which protocol.

    ``window_s`` and ``repeats`` default to what the protocol asks for.
    """

    protocol: Protocol = setting("grouped", "Which windows train and which test.")
    extras: bool = setting(True, "Speed alone, slow against fast, learning curve.")
    speed: str | None = setting(
        None, "LOW:HIGH in m/s: runs commanded at such a speed alone (or, without commands, driven at)."
    )

    @property
    def speed_mps(self) -> tuple[float, float] | None:
        """Speeds of the runs that are used; None for all."""
        return None if self.speed is None else _speeds(self.speed)

    @field_validator("speed")
    @classmethod
    def _check_speed(cls, text: str | None) -> str | None:
        if text is not None:
            _speeds(text)
        return text

    @model_validator(mode="after")
    def _check_protocol(self) -> Self:
        if self.protocol == "published" and (self.stride_s is not None or not self.steady):
            raise ConfigError(
                "'published' sets its own strides and keeps all motion: stride and steady do not apply"
            )
        if (
            self.protocol in ("leave-one-run-out", "leave-sessions-out", *SPEED_PROTOCOLS)
            and (self.repeats or 1) > 1
        ):
            raise ConfigError(f"{self.protocol!r} has a single fold assignment: it has one repeat")
        return self

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        return _rule(self, PUBLISHED_WINDOW_S if self.protocol == "published" else WINDOW_S)

    @property
    def n_repeats(self) -> int:
        """Fold assignments: what was asked for, or what the protocol asks for."""
        return self.repeats or (5 if self.protocol in ("grouped", "leave-regimes-out", "published") else 1)


def _speeds(text: str) -> tuple[float, float]:
    """Read ``LOW:HIGH``."""
    low, _, high = text.partition(":")
    try:
        low_mps, high_mps = float(low), float(high)
    except ValueError:
        low_mps = high_mps = 0.0
    if not 0.0 <= low_mps < high_mps < math.inf:
        raise ConfigError(f"--speed is {text!r}; LOW:HIGH in m/s is required, as in 0:0.15")
    return low_mps, high_mps


def _rule(settings: RecipeSettings, default_s: float) -> WindowRule:
    from features.windows import WindowRule

    length_s = default_s if settings.window_s is None else settings.window_s
    return WindowRule(length_s, settings.stride_s, WindowRule().steady if settings.steady else None)
