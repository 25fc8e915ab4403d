"""Results become JSON by one rule; former keys are written beside the new ones."""

import json
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from pipelines.reporting import json_file
from pipelines.reporting.json_file import as_json, with_deprecated_keys, write_json


class Colour(Enum):
    red = "red"


class Point(NamedTuple):
    x: float
    y: float | None


@dataclass(frozen=True, slots=True)
class Drawn:
    colour: Colour
    points: tuple[Point, ...]
    file: Path


class Shown(NamedTuple):
    value: float

    def as_json(self):
        return {"shown": self.value}


def test_every_kind_of_value_becomes_what_json_holds():
    drawn = Drawn(Colour.red, (Point(1.0, None), Point(math.nan, math.inf)), Path("a/b"))
    found = as_json(
        {"drawn": drawn, 3: np.array([1, 2]), "n": np.float64(0.5), "own": Shown(2.0), "on": True}
    )
    assert found == {
        "drawn": {"colour": "red", "points": [{"x": 1.0, "y": None}, {"x": None, "y": None}], "file": "a/b"},
        "3": [1, 2],
        "n": 0.5,
        "own": {"shown": 2.0},
        "on": True,
    }
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_former_keys_are_written_beside_the_new_ones_at_any_depth(monkeypatch, tmp_path):
    monkeypatch.setattr(json_file, "DEPRECATED_KEYS", {"new": "old"})
    assert with_deprecated_keys({"a": [{"new": 1}], "new": {"new": 2}}) == {
        "a": [{"new": 1, "old": 1}],
        "new": {"new": 2, "old": 2},
        "old": {"new": 2, "old": 2},
    }
    write_json(tmp_path / "result.json", {"new": 1})
    assert json.loads((tmp_path / "result.json").read_text()) == {"new": 1, "old": 1}
    write_json(None, {"new": 1})


def test_a_value_that_json_cannot_hold_is_an_error():
    with pytest.raises(TypeError):
        as_json(object())
