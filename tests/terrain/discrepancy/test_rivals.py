"""Which effects fit as well in the place of a cause, by the losses and squares of their fits."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest

from terrain.discrepancy import search as rivals
from terrain.discrepancy.search import RIVAL_LOSS, RIVAL_RISE, Refit, rivals_of
from terrain.effects import effect_named

CAUSE, OTHER = effect_named("payload"), effect_named("motor_constant")
SQUARE = 1000.0


@dataclass(frozen=True)
class Judge:
    """Evidence of which only the point is read."""

    vector: tuple = (0.0,)
    model_std: tuple = (0.0,)


@pytest.fixture
def fitted(monkeypatch):
    """Return a function that sets loss and square of the other effect's fit, and returns the rivals."""

    def found(behind, square, inflation=1.0):
        def fit(problem, judge, base, names):
            own = names == (CAUSE.parameters[0].name,)
            return Refit(0.0 if own else behind, SQUARE if own else square, np.array([0.1]), np.array([0.01]))

        monkeypatch.setattr(rivals, "fit_again", fit)
        monkeypatch.setattr(rivals, "_near", lambda *_: [OTHER])
        monkeypatch.setattr(rivals, "wald_test", lambda *_: SimpleNamespace(inflation=inflation))
        monkeypatch.setattr(rivals, "_allowed", lambda *_: RIVAL_LOSS)
        found = rivals_of(None, Judge(), Judge(), [CAUSE])
        return [each.effect.name for each in found[CAUSE.name]]

    return found


def test_an_effect_that_is_little_behind_is_a_rival(fitted):
    assert fitted(RIVAL_LOSS - 1.0, SQUARE) == [OTHER.name]
    assert fitted(RIVAL_LOSS + 1.0, SQUARE) == []


def test_an_effect_that_leaves_a_larger_square_is_no_rival(fitted):
    most = (1.0 + RIVAL_RISE) * SQUARE + RIVAL_LOSS
    assert fitted(-50.0, most - 1.0) == [OTHER.name]
    assert fitted(-50.0, most + 1.0) == []


def test_losses_count_less_where_runs_disagree_on_the_cause(fitted):
    assert fitted(3.0 * RIVAL_LOSS, SQUARE) == []
    assert fitted(3.0 * RIVAL_LOSS, SQUARE, inflation=4.0) == [OTHER.name]
