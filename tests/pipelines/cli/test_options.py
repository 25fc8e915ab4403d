"""The settings of a command become its options: defaults once, grouped help, mistakes in one sentence."""

import json
import sys
from typing import Literal

import pytest

from pipelines.cli import main as cli
from pipelines.cli.options import next_command
from pipelines.cli.table import COMMANDS, FORMER, Command
from pipelines.report.results import Result, described
from pipelines.report.settings import Names, setting
from pipelines.report.settings import Settings as BaseSettings
from pipelines.report.tree import Report, Section, Text
from terrain.errors import ConfigError, DataError
from terrain.files.names import data_folder

EXAMPLE = "terrain draw --folder a"


class Folding(BaseSettings):
    """How it is folded."""

    seed: int = setting(0, "Of all that is drawn.", ge=0)


class Settings(Folding):
    """What is drawn."""

    folder: str = setting(..., "Where it goes.")
    protocol: Literal["grouped", "published"] = setting("grouped", "Which.")
    window_s: float | None = setting(None, "Length.", option="--window", gt=0)
    figures: bool = setting(True, "Draw.")
    signal_sets: Names = setting(("imu", "currents"), "By commas.", option="--signals")
    effect: tuple[str, ...] = setting((), "May be given again.", repeated=True)
    inner: int = setting(3, "Not on the command line.", option="")


class Drawn(Result):
    settings: Settings = described("what was asked for")
    ratio: float = described("of nothing", "1")

    def as_json(self):
        return {"ratio": None, "folder": self.settings.folder}


TAKEN = []


def run(settings, progress):
    if settings.folder == "nowhere":
        raise DataError("nowhere: is no folder")
    TAKEN.append(settings)
    return Drawn(settings, float("nan"))


def report(result):
    return Report(
        "Drawing", "It is drawn.", details=[Section("More", [Text("all of it")])], next_step="terrain b"
    )


@pytest.fixture
def draw(monkeypatch, terrain):
    """Run ``terrain draw`` with words: exit code, output, errors; the settings go to ``TAKEN``."""
    monkeypatch.setitem(sys.modules, "drawing_command", sys.modules[__name__])
    monkeypatch.setattr(cli, "COMMANDS", (*COMMANDS, Command("Data", "draw", "drawing_command", "draws")))
    TAKEN.clear()
    return lambda *words: terrain("draw", *words)


def test_every_option_reaches_the_model_and_defaults_are_those_of_the_model(draw):
    draw("--folder", "a")
    assert TAKEN.pop() == Settings(folder="a")
    words = ["--folder", "a", "--protocol", "published", "--window", "1.5", "--seed", "4", "--no-figures"]
    draw(*words, "--signals", "imu, gnss", "--effect", "a=1", "--effect", "b=2")
    given = {"protocol": "published", "window_s": 1.5, "seed": 4, "figures": False}
    assert TAKEN.pop() == Settings(folder="a", signal_sets=("imu", "gnss"), effect=("a=1", "b=2"), **given)


def test_a_mistake_is_one_sentence_and_code_2(draw):
    for words, sentence in (
        ("--folder a --seed -1", "--seed is -1: input should be greater than or equal to 0"),
        ("--folder a --window wide", "--window is 'wide': input should be a valid number"),
        ("--folder a --protocol odd", "--protocol is 'odd': input should be 'grouped' or 'published'"),
        ("", "--folder is missing"),
        ("--folder nowhere", "nowhere: is no folder"),
        ("--foldr a", "No such option '--foldr'. Did you mean '--folder'?"),
        ("--folder a --report a.pdf", "--report is 'a.pdf'; a name that ends in .html or .md is required"),
    ):
        code, out, err = draw(*words.split())
        assert (code, out, TAKEN) == (2, "", [])
        assert err.startswith(f"error: {sentence}")
        assert err.count("\n") == 1


def test_help_begins_with_an_example_and_groups_options(draw):
    code, out, _ = draw("-h")
    assert code == 0
    assert out.startswith(EXAMPLE)
    options = out[len(EXAMPLE) :]
    order = "Required:, --folder, What is drawn:, --window, How it is folded:, --seed, Output:, --json"
    places = [options.index(word) for word in order.split(", ")]
    assert places == sorted(places)
    assert "[default: imu,currents]" in out
    assert "inner" not in out


def test_json_and_page_are_written_and_details_are_asked_for(draw, tmp_path):
    files = ["--json", str(tmp_path / "new" / "a.json"), "--report", str(tmp_path / "a.html")]
    code, out, _ = draw("--folder", "a", *files)
    assert (code, out) == (0, "It is drawn.\n--details adds: More\nnext: terrain b\n")
    assert json.loads((tmp_path / "new" / "a.json").read_text()) == {"ratio": None, "folder": "a"}
    assert "<summary>More</summary>" in (tmp_path / "a.html").read_text()
    assert "all of it" in draw("--folder", "a", "--details")[1]


def test_the_next_command_is_given_the_data_the_mapping_and_the_robot_that_it_takes(tmp_path):
    robot = tmp_path / "mine.yaml"
    robot.write_text((data_folder("robots") / "husky.yaml").read_text())
    given = {"data": "logs", "mapping": "map.yaml", "robot": str(robot)}
    for step, next_step in (
        (
            "terrain convert DIR --out raw/",
            f"terrain convert logs --out raw/ --mapping map.yaml --robot {robot}",
        ),
        ("terrain estimate --data raw", f"terrain estimate --data raw --robot {robot}"),
        ("terrain drive --robot husky --table t", f"terrain drive --robot {robot} --table t"),
        (
            "terrain estimate --data DIR --robot new.yaml",
            "terrain estimate --data logs --robot new.yaml --mapping map.yaml",
        ),
        ("record more runs", "record more runs"),
    ):
        assert next_command(step, given) == next_step
        assert next_command(step, {}) == step


def test_a_former_command_names_its_successor(terrain):
    code, _, err = terrain("compare", "--folder", "a")
    assert (code, err) == (2, f"error: there is no command 'compare' any more: {FORMER['compare']}\n")
    assert terrain("explian")[2] == "error: there is no command 'explian'; the nearest is 'explain'\n"


def test_unknown_settings_are_refused_and_settings_do_not_change():
    with pytest.raises(ConfigError, match=r"^there is no setting 'sed'$"):
        Settings(folder="a", sed=1)
    settings = Settings(folder="a")
    with pytest.raises(ValueError, match="frozen"):
        settings.seed = 1
    assert settings.with_(seed=2).seed == 2
    with pytest.raises(ConfigError, match="--seed is -2"):
        settings.with_(seed=-2)
