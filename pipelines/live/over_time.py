"""The terrain by all windows so far: a causal filter over overlapping windows in place of a dwell time.

:func:`filtered` makes of a model one whose windows begin every quarter of a second, and whose outputs are
filtered; whatever takes a model takes it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar, cast

from pipelines.live.model import LiveModel, WindowsInfo
from terrain.classify.terrain_filter import TerrainFilter, check_filter
from terrain.errors import ConfigError

Model = TypeVar("Model", bound=LiveModel)

STRIDE_S = 0.25


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
