"""The terrain by all windows so far: a causal filter over overlapping windows in place of a dwell time.

:func:`filtered` makes of a model one whose windows begin every quarter of a second, and whose outputs are
filtered; whatever takes a model takes it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from pipelines.live.classifying import WindowOutput
from pipelines.live.model import LiveModel, WindowsInfo
from terrain.classify.terrain_filter import (
    FilterBelief,
    TerrainFilter,
    check_filter,
    filter_step,
    initial_belief,
    reported,
)
from terrain.control.switching import UNKNOWN, SwitchSettings
from terrain.errors import ConfigError
from terrain.records import Array

Model = TypeVar("Model", bound=LiveModel)

STRIDE_S = 0.25

DETECTED_RATIO = 0.2
"""Assumed share of the windows of a terrain that was never learned that are found to be unknown.  It is 0.17
of those of BorealTC, each terrain left out in turn, at the threshold that keeps 95 % of known windows."""

KNOWN_FLAGGED_RATIO = 0.05
"""Share of windows of learned terrains that are taken for unknown, by the definition of the threshold."""


def filter_of(info: WindowsInfo) -> TerrainFilter:
    """Return the filter of a model: shares of its classes in training, equal ones where it has none."""
    prior = tuple(float(info.class_ratio.get(name, 1.0 / len(info.classes))) for name in info.classes)
    return check_filter(TerrainFilter(prior))


def filtered(model: Model, stride_s: float | None = STRIDE_S) -> Model:
    """Return a model whose windows begin every ``stride_s`` and are filtered; the model itself for None.

    Raises
    ------
    ConfigError
        if the stride is not above zero, or longer than a window.
    """
    if stride_s is None:
        return model
    if not 0.0 < stride_s <= model.info.window_s:
        raise ConfigError(
            f"filter stride is {stride_s:g} s: above zero and at most a window, {model.info.window_s:g} s, "
            "is required"
        )
    changed: Any = model
    info = replace(changed.info, stride_s=stride_s)
    return cast(Model, changed._replace(info=info, over_time=filter_of(model.info)))


def novelty_evidence(novelty: Array, unknown: Array) -> Array:
    """Return the log-likelihood (n,) of an unknown terrain against the learned ones; 0 without a score.

    Examples
    --------
    >>> novelty_evidence(np.array([9.0, 1.0, np.nan]), np.array([True, False, False])).round(2).tolist()
    [1.39, -0.17, 0.0]
    """
    flagged = math.log(DETECTED_RATIO / KNOWN_FLAGGED_RATIO)
    passed = math.log((1.0 - DETECTED_RATIO) / (1.0 - KNOWN_FLAGGED_RATIO))
    return np.asarray(np.where(np.isnan(novelty) & ~unknown, 0.0, np.where(unknown, flagged, passed)))


class GroundFilter:
    """The filter's belief, from one output to the next.

    Parameters
    ----------
    settings : of the filter

    Examples
    --------
    >>> ground = GroundFilter(TerrainFilter((0.5, 0.5)))
    >>> for end_s in (2.0, 2.25, 2.5, 2.75):
    ...     output = WindowOutput(end_s - 2, end_s, "a", 0.9, np.array([0.9, 0.1]), ("a", "b"))
    ...     terrain, probability = ground.take(output)
    >>> terrain, round(probability, 2)
    ('a', 0.97)
    """

    def __init__(self, settings: TerrainFilter) -> None:
        self.settings = settings
        self._belief: FilterBelief = initial_belief(settings)
        self._end_s = math.nan

    def take(self, output: WindowOutput) -> tuple[str, float]:
        """Return the terrain after an output, and its probability; empty where none is certain enough.

        An output that was refused lets the belief widen, one that is not later than the last is no evidence.
        """
        dt_s = output.end_s - self._end_s
        if math.isnan(dt_s):
            dt_s = 0.0
        elif dt_s <= 0.0:
            return self._reported(output.classes)
        self._end_s = output.end_s
        evidence = novelty_evidence(np.array([output.novelty]), np.array([output.unknown]))
        self._belief = filter_step(
            self._belief, output.probabilities, dt_s, self.settings, float(evidence[0])
        )
        return self._reported(output.classes)

    def _reported(self, classes: tuple[str, ...]) -> tuple[str, float]:
        belief = self._belief.probability
        best = int(reported(belief[None], self.settings.threshold)[0])
        return (classes[best], float(belief[best])) if best >= 0 else (UNKNOWN, math.nan)


def ground_filter(model: LiveModel) -> GroundFilter | None:
    """Return the filter of a model's outputs, at its beginning; None where they are not filtered."""
    return None if model.over_time is None else GroundFilter(model.over_time)


def without_dwell(switching: SwitchSettings) -> SwitchSettings:
    """Return settings under which each output of a filter is accepted at once: the filter is the dwell."""
    return switching._replace(dwell_s=0.0, probability_least=0.0)
