"""Robots of other groups, tuned to by none of this: the first halves of their drives hold on the second ones."""

import importlib
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "examples" / "unseen"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))

    def load(name):
        sys.modules.pop(name, None)
        return importlib.import_module(name)

    return load


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "folder", "least"),
    [
        ("mecanum", "mecanum", 5),
        ("tricycle", "tricycle", 6),
        ("race_car", "race_car", 3),
        ("recordings", "drive_recordings", 3),
    ],
)
def test_numbers_of_the_first_half_hold_on_the_second(measured, script, capsys, name, folder, least):
    """Of intervals of 95 % one in 20 may miss."""
    verdicts = script(name).main(measured(folder))
    assert verdicts.count("holds") >= least
    assert verdicts.count("DOES NOT HOLD") <= 1
    assert "95 % intervals" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mecanum", "tricycle"])
def test_the_simulation_with_these_numbers_lacks_little(measured, script, capsys, tmp_path, name):
    script(name).main(measured(name), tmp_path)
    assert (tmp_path / "report.html").stat().st_size > 10_000
    assert "beyond these numbers" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["mecanum", "tricycle", "race_car", "recordings"])
def test_a_wrong_folder_is_one_sentence(script, monkeypatch, tmp_path, name):
    module = script(name)
    monkeypatch.setattr(sys, "argv", [name, str(tmp_path / "nowhere")])
    with pytest.raises(SystemExit, match=r"^error: .*nowhere.*does not exist") as refused:
        module.answer("nowhere", "", module.main)
    assert "\n" not in str(refused.value)
