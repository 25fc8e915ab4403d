"""Settings that evaluation and training have in common: windows, folds, and the recipe."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, model_validator

from pipelines.report.settings import JobsSettings, Names, Settings, setting
from terrain.errors import ConfigError
from terrain.logs.schema import SIGNAL_SETS, check_signal_sets

if TYPE_CHECKING:
    from features.windows import WindowRule
    from pipelines.live.model import TerrainModel

RECIPES = (
    "svm",
    "trees",
    "cnn",
    "stack",
    "best",
    "response",
    "plain",
)  #: The names of ``features.recipes.RECIPES``
FEATURE_RECIPE = "svm"  #: The recipe that learns from features alone, and so from cached ones
WITHOUT_SVM = ("trees", "cnn", "response", "plain")

ProtocolName = Literal[
    "grouped",
    "grouped-by-run",
    "leave-one-run-out",
    "leave-sessions-out",
    "leave-regimes-out",
    "leave-terrain-out",
    "published",
    "slow-fast",
    "fast-slow",
]
"""The names of ``features.protocols.PROTOCOLS``."""
SEVERAL_REPEATS = ("grouped", "grouped-by-run", "leave-regimes-out", "leave-terrain-out", "published")

WINDOW_S = 2.0
PUBLISHED_WINDOW_S = 1.7

RECIPE_TEXT = (
    "svm or trees on features, cnn (network on samples), stack (svm and cnn joined), best of these four, response of "
    "wheels, plain (baseline); MODULE:NAME of a scikit-learn classifier of your own. @SET,SET after it: signal sets."
)


def check_recipe(text: str) -> str:
    """Raise ``ConfigError`` where a text names no recipe, or a signal set that is not known."""
    name, separator, sets = text.partition("@")
    if name not in RECIPES and ":" not in name:
        raise ConfigError(
            f"there is no recipe {name!r}; there are {', '.join(RECIPES)}, or MODULE:NAME of your own"
        )
    if separator:
        check_signal_sets(tuple(part.strip() for part in sets.split(",")))
    return text


def split_recipes(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Return recipes that are written one a text or several by commas; a signal set belongs to its recipe.

    Examples
    --------
    >>> split_recipes(("svm@imu,wheels,cnn", "mine:make"))
    ('svm@imu,wheels', 'cnn', 'mine:make')
    """
    found: list[str] = []
    for part in (part.strip() for text in texts for part in text.split(",")):
        if part in SIGNAL_SETS and found and "@" in found[-1]:
            found[-1] += f",{part}"
        elif part:
            found.append(part)
    return tuple(map(check_recipe, found))


def stream_rate(text: str) -> tuple[str, float]:
    """Return stream and rate in Hz of a text; ``ConfigError`` where it is none.

    Examples
    --------
    >>> stream_rate("imu=50")
    ('imu', 50.0)
    """
    stream, _, rate = text.partition("=")
    try:
        rate_hz = float(rate)
    except ValueError:
        rate_hz = math.nan
    if not (stream and 0.0 < rate_hz < math.inf):
        raise ConfigError(f"--rate is {text!r}; STREAM=HZ is required, as in imu=50")
    return stream, rate_hz


def check_rates(texts: tuple[str, ...]) -> tuple[str, ...]:
    """Raise ``ConfigError`` where a text is no stream with a rate."""
    for text in texts:
        stream_rate(text)
    return texts


class TrustSettings(Settings):
    """Models that need code of one's own."""

    trust: tuple[str, ...] = setting((), repeated=True)
    """Module of your own that the model may run; remembered, and may be given again."""

    def read_model(self, source: str | Path) -> TerrainModel:
        """Remember what is trusted, and read a model; errors as of both."""
        from pipelines.learn.model_file import read_model
        from pipelines.learn.trust import remember

        remember(self.trust)
        return read_model(source)


class WindowSettings(Settings):
    """Windows: how runs are cut, and which signals are used."""

    window_s: float | None = setting(None, "Window length in s (2; 1.7 under 'published').", "--window")
    stride_s: float | None = setting(None, "From window to window in s; one length by default.", "--stride")
    steady: bool = setting(True, "Keep windows of steady motion only.")
    signal_sets: Annotated[Names, AfterValidator(check_signal_sets)] = setting(
        SIGNAL_SETS, option="--signals"
    )
    """Signal sets to use, by commas; leave one out to see what it is worth."""
    merge_duplicates: bool = setting(False)
    """Treat runs that hold the same measurements as one run instead of refusing them."""
    skip_short: bool = setting(False, "Leave out and count runs shorter than a window.", option="")
    rate: Annotated[tuple[str, ...], AfterValidator(check_rates)] = setting((), repeated=True)
    """STREAM=HZ: resample the windows of a stream to a lower rate, from which the model takes logs then."""

    @property
    def rule(self) -> WindowRule:
        """How windows are cut."""
        from features.windows import WindowRule

        default_s = PUBLISHED_WINDOW_S if getattr(self, "protocol", "") == "published" else WINDOW_S
        length_s = default_s if self.window_s is None else self.window_s
        return WindowRule(length_s, self.stride_s, WindowRule().steady if self.steady else None)

    @property
    def reading(self) -> dict[str, Any]:
        """How runs are taken, as :func:`features.protocols.samples_of` has it."""
        rate_hz = dict(map(stream_rate, self.rate))
        return {"merge_duplicates": self.merge_duplicates, "skip_short": self.skip_short, "rate_hz": rate_hz}


class LearnSettings(WindowSettings, JobsSettings):
    """Learning: folds of runs, features and hyper-parameters."""

    repeats: int | None = setting(None, "Fold assignments (5).", ge=1)
    seed: int = setting(0, "Deals runs into folds.", ge=0)
    feature: tuple[str, ...] = setting((), repeated=True)
    """MODULE:NAME of a function of a window of your own, beside the features; may be given again."""
    params: Path | None = setting(None, "Result of a search, in place of the SVM's own choice.")
    cache: Path | None = setting(None, "Folder of cached features; one that was interrupted goes on.")

    @property
    def recipes(self) -> tuple[str, ...]:
        """The recipes by name; the SVM where none is given."""
        given: str | tuple[str, ...] = getattr(self, "recipe", ())
        return ((given,) if isinstance(given, str) else given) or (FEATURE_RECIPE,)

    @model_validator(mode="after")
    def _check_learning(self) -> Self:
        for name in (text.partition("@")[0] for text in self.recipes):
            if self.params is not None and (name in WITHOUT_SVM or ":" in name):
                raise ConfigError(f"--params has hyper-parameters of the SVM, which {name!r} does not have")
        if self.cache is not None:
            self.require_features("--cache")
            if self.merge_duplicates:
                raise ConfigError("--cache keeps each run by itself: it does not go with --merge-duplicates")
        return self

    def require_features(self, option: str) -> None:
        """Raise ``ConfigError`` where the recipe learns from more than the package's own features."""
        if [text.partition("@")[0] for text in self.recipes] != [FEATURE_RECIPE] or self.feature:
            raise ConfigError(
                f"{option} is for recipe {FEATURE_RECIPE!r} on the package's own features, not for "
                f"{', '.join(self.recipes)}{' with --feature' if self.feature else ''}"
            )


class RecipeSettings(LearnSettings):
    """One recipe."""

    # what is trained is judged by whole runs held out, without further checks
    protocol: ClassVar[str] = "grouped"
    extras: ClassVar[bool] = False
    recipe: Annotated[str, AfterValidator(check_recipe)] = setting(FEATURE_RECIPE, RECIPE_TEXT)


class EvaluationSettings(LearnSettings, TrustSettings):
    """Evaluation: what is compared, and which windows are held out."""

    recipe: Annotated[tuple[str, ...], AfterValidator(split_recipes)] = setting(
        (), f"Recipes to evaluate (svm), by commas or repeated: {RECIPE_TEXT}", repeated=True
    )
    model: tuple[str, ...] = setting((), repeated=True)
    """Model folder or URI in place of recipes; may be given again."""
    protocol: ProtocolName = setting("grouped", "Which windows train and which test.")
    extras: bool = setting(True, "Speed alone, slow against fast, learning curve, terrain over time.")
    speed: str | None = setting(None)
    """LOW:HIGH in m/s: runs commanded at such a speed alone (or, without commands, driven at)."""

    @model_validator(mode="after")
    def _check_protocol(self) -> Self:
        if self.model and self.recipe:
            raise ConfigError("--model and --recipe do not go together: compare models, or recipes")
        _ = self.speed_mps
        if self.protocol == "published" and (self.stride_s is not None or not self.steady):
            raise ConfigError(
                "'published' sets its own strides and keeps all motion: stride and steady do not apply"
            )
        if self.protocol not in SEVERAL_REPEATS and (self.repeats or 1) > 1:
            raise ConfigError(f"{self.protocol!r} has a single fold assignment: it has one repeat")
        return self

    @property
    def speed_mps(self) -> tuple[float, float] | None:
        """Speeds of the runs that are used; None for all.

        Raises
        ------
        ConfigError
            if the text is no ``LOW:HIGH``.
        """
        if self.speed is None:
            return None
        low, _, high = self.speed.partition(":")
        try:
            low_mps, high_mps = float(low), float(high)
        except ValueError:
            low_mps = high_mps = 0.0
        if not 0.0 <= low_mps < high_mps < math.inf:
            raise ConfigError(f"--speed is {self.speed!r}; LOW:HIGH in m/s is required, as in 0:0.15")
        return low_mps, high_mps
