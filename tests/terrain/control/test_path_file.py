"""A file of a path is read, and what is no path is one sentence."""

import numpy as np
import pytest

from terrain.control.paths import ROLL, read_path
from terrain.errors import TerrainError


def bend(n=80, radius=12.0):
    angle = np.linspace(0.0, 2.0, n)
    return radius * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])


def test_roll_of_a_file_is_that_of_the_path(tmp_path):
    file = tmp_path / "rolled.csv"
    points = bend()
    rows = np.column_stack([points, np.linspace(0.0, 0.2, len(points))])
    np.savetxt(file, rows, delimiter=",", header="position_x_m,position_y_m,roll_rad", comments="")
    path = read_path(file)
    assert path.rows[[0, -1], ROLL] == pytest.approx([0.0, 0.2], abs=0.005)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "columns x_m and y_m"),
        ("x_m,y_m\n0,0\n1,two\n", "row 3 has 'two'"),
        ("x_m,y_m\n0,0\n1\n", "row 3 has 'nothing'"),
        ("x_m,y_m\n0,0\n1,nan\n2,0\n3,0\n", "point 2"),
        ("x_m,y_m\n0,0\n1,0\n", "2 different points"),
        ("5\n6\n", "two columns"),
        ("x_m,y_m,roll_rad\n0,0,0\n1,0,3\n2,0,0\n3,0,0\n", "roll_rad is beyond"),
    ],
)
def test_a_file_that_is_no_path_is_one_sentence(tmp_path, text, message):
    file = tmp_path / "path.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(TerrainError, match=message) as refused:
        read_path(file)
    assert str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_bytes_and_folders_are_no_path(tmp_path):
    (tmp_path / "noise.csv").write_bytes(b"\xff\xfe\x00\x9f")
    for place in (tmp_path, tmp_path / "noise.csv", tmp_path / "none.csv"):
        with pytest.raises(TerrainError, match="cannot be read"):
            read_path(place)
