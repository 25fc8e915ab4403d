"""A settings model becomes options: defaults once, former options hidden, mistakes in one sentence."""

from typing import Literal

import pytest
import typer
from typer.testing import CliRunner

from pipelines.cli.command import command
from pipelines.report.settings import Settings, option_name, setting
from terrain.errors import ConfigError


class Drawn(Settings):
    folder: str = setting(..., "Where it goes.")
    protocol: Literal["grouped", "published"] = setting("grouped", "Which.")
    window_s: float | None = setting(None, "Length.", option="--window", gt=0)
    seed: int = setting(0, "Of all that is drawn.", ge=0)
    figures: bool = setting(True, "Draw.")
    signal_sets: tuple[str, ...] = setting(
        ("imu", "currents"), "By commas.", option="--signals", separated=True
    )
    effect: tuple[str, ...] = setting((), "May be given again.")
    leg_backlash_rad: float = setting(0.0, "Backlash.", option="--leg-backlash", aliases=("--leg-play",))
    inner: int = setting(3, "Not on the command line.", option="")


@pytest.fixture
def run():
    app, taken = typer.Typer(), []

    @command(app, "draw")
    def draw(settings: Drawn) -> None:
        """Draw."""
        taken.append(settings)

    @app.command("other")
    def other() -> None:
        """Do nothing."""

    def invoke(*words):
        taken.clear()
        found = CliRunner().invoke(app, ["draw", *words])
        return found, taken[0] if taken else None

    return invoke


def test_defaults_are_those_of_the_model(run):
    _, settings = run("--folder", "a")
    assert settings == Drawn(folder="a")
    assert settings.inner == 3


def test_every_option_reaches_the_model(run):
    words = ["--folder", "a", "--protocol", "published", "--window", "1.5", "--seed", "4", "--no-figures"]
    _, settings = run(*words, "--signals", "imu, gnss", "--effect", "a=1", "--effect", "b=2")
    assert settings == Drawn(
        folder="a",
        protocol="published",
        window_s=1.5,
        seed=4,
        figures=False,
        signal_sets=("imu", "gnss"),
        effect=("a=1", "b=2"),
    )


def test_a_former_option_is_accepted_and_hidden(run):
    _, settings = run("--folder", "a", "--leg-play", "0.02")
    assert settings.leg_backlash_rad == 0.02
    shown, _ = run("--help")
    assert "--leg-backlash" in shown.output
    assert "--leg-play" not in shown.output
    assert "inner" not in shown.output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--seed", "-1"], "--seed is -1: input should be greater than or equal to 0"),
        (["--window", "0"], "--window is 0.0: input should be greater than 0"),
    ],
)
def test_what_is_not_accepted_is_one_sentence(run, words, message):
    found, settings = run("--folder", "a", *words)
    assert settings is None
    assert isinstance(found.exception, ConfigError)
    assert str(found.exception) == message


def test_a_choice_that_there_is_not_ends_with_code_2(run):
    found, settings = run("--folder", "a", "--protocol", "odd")
    assert (settings, found.exit_code) == (None, 2)
    assert "grouped" in found.output


def test_unknown_settings_are_refused_and_settings_do_not_change():
    with pytest.raises(ConfigError, match=r"^there is no setting 'sed'$"):
        Drawn(folder="a", sed=1)
    with pytest.raises(ConfigError, match=r"^--folder is missing$"):
        Drawn()
    settings = Drawn(folder="a")
    with pytest.raises(ValueError, match="frozen"):
        settings.seed = 1
    assert settings.with_(seed=2).seed == 2
    with pytest.raises(ConfigError, match="--seed is -2"):
        settings.with_(seed=-2)
    assert option_name(Drawn, "window_s") == "--window"
