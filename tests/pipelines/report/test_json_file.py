"""Results become JSON by one rule."""

import json
import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from pipelines.report.json_file import as_json, write_json


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


def test_a_file_is_written_whole_and_only_where_one_is_named(tmp_path):
    write_json(tmp_path / "result.json", {"new": math.nan})
    assert json.loads((tmp_path / "result.json").read_text()) == {"new": None}


def test_a_value_that_json_cannot_hold_is_an_error():
    with pytest.raises(TypeError):
        as_json(object())
