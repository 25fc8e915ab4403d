"""Settings of ``terrain compare``."""

from __future__ import annotations

from typing import Any, NamedTuple, Self

from pydantic import model_validator

from pipelines.crossval.settings import RECIPES, CrossvalSettings, Recipe, RecipeSettings
from pipelines.report.settings import setting
from terrain.errors import ConfigError


class Contender(NamedTuple):
    """A recipe with the signal sets that it uses; None for those of the command."""

    recipe: str
    signal_sets: tuple[str, ...] | None

    @classmethod
    def from_text(cls, text: str) -> Self | None:
        """Return the contender that ``RECIPE`` or ``RECIPE@SET,SET`` names; None where it names no recipe.

        Examples
        --------
        >>> Contender.from_text("svm@imu,wheels")
        Contender(recipe='svm', signal_sets=('imu', 'wheels'))
        >>> Contender.from_text("models:/field@champion")
        """
        recipe, separator, sets = text.partition("@")
        if recipe not in RECIPES:
            return None
        return cls(recipe, tuple(name.strip() for name in sets.split(",")) if separator else None)


class CompareSettings(RecipeSettings):
    """Which two recipes or models are compared, and on which windows and folds."""

    a: str = setting(..., "RECIPE, RECIPE@SIGNAL_SET,..., or a model (URI or folder).", "A")
    b: str = setting(..., "What is compared with it, of the same kind.", "B")
    recipe: Recipe = setting("svm", "Not used: A and B name the recipes.", option="")

    @model_validator(mode="after")
    def _check_kinds(self) -> Self:
        kinds = [Contender.from_text(text) is None for text in (self.a, self.b)]
        if kinds[0] != kinds[1]:
            model, recipe = (self.a, self.b) if kinds[0] else (self.b, self.a)
            raise ConfigError(
                f"{recipe!r} is a recipe and {model!r} is not: compare two models or two recipes "
                f"({', '.join(RECIPES)}, also as svm@imu,wheels)"
            )
        return self

    @property
    def contenders(self) -> tuple[Contender, Contender] | None:
        """The two recipes; None where models are compared."""
        a, b = Contender.from_text(self.a), Contender.from_text(self.b)
        return None if a is None or b is None else (a, b)

    def evaluation(self, contender: Contender) -> CrossvalSettings:
        """Return how a recipe is evaluated: on whole held-out runs, the same for both."""
        fields: dict[str, Any] = self.shared() | {"recipe": contender.recipe}
        if contender.signal_sets is not None:
            fields["signal_sets"] = contender.signal_sets
        return CrossvalSettings(**fields, extras=False)
