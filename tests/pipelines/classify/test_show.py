"""``terrain model`` prints what lies beside a model, and nothing of what is damaged."""

import json

import pytest
from rich.console import Console

from pipelines.classify.card import CARD_JSON
from pipelines.classify.show import model_statement, print_model
from pipelines.models.model_files import read_model, write_info
from pipelines.reporting.json_file import as_json
from terrain.errors import ModelError


def test_a_registered_model_and_its_folder_state_the_same(in_tracked, model_dir):
    by_name = model_statement("models:/drawn@champion")
    by_folder = model_statement(str(model_dir))
    assert by_name._replace(model="") == by_folder._replace(model="")
    assert (by_name.recipe, by_name.classes) == ("svm", ("ASPHALT", "GRASS", "GRAVEL"))
    assert (by_name.finds_unknown, by_name.counts_support, by_name.names_sets) == (True, True, True)
    assert by_name.n_training_runs == 12
    json.dumps(as_json(by_name), allow_nan=False)
    console = Console(width=200, record=True)
    print_model(by_name, console)
    text = console.export_text()
    assert f"accuracy of single windows: {in_tracked.crossval.accuracy:.1%}" in text
    for row in in_tracked.crossval.support.rows:
        cell = f"{row.n_runs}/{row.windows} {row.accuracy:.0%}" if row.windows else "none"
        (line,) = [each for each in text.splitlines() if each.lstrip().startswith(row.regime)]
        assert cell in line
    for expected in ("GRAVEL", "not for: Robots other than husky", "novelty.npz", "answers unknown: yes"):
        assert expected in text


def test_a_card_of_an_earlier_release_has_no_table_of_support(model_dir):
    info = read_model(model_dir).info
    card = json.loads((model_dir / CARD_JSON).read_text())
    del card["support"]
    (model_dir / CARD_JSON).write_text(json.dumps(card))
    write_info(model_dir, info)
    console = Console(width=200, record=True)
    print_model(model_statement(str(model_dir)), console)
    assert "when held out" not in console.export_text()


def test_a_model_without_a_card_says_so(model_dir):
    info = read_model(model_dir).info
    (model_dir / CARD_JSON).unlink()
    write_info(model_dir, info)
    found = model_statement(str(model_dir))
    assert found.card is None
    console = Console(width=200, record=True)
    print_model(found, console)
    assert "it has no card" in console.export_text()


@pytest.mark.parametrize("content", ["{", "[]", '{"name": "x"}'])
def test_a_card_that_is_none_is_one_sentence(model_dir, content):
    info = read_model(model_dir).info
    (model_dir / CARD_JSON).write_text(content)
    with pytest.raises(ModelError, match="is damaged"):
        model_statement(str(model_dir))  # its checksum differs
    write_info(model_dir, info)
    with pytest.raises(ModelError) as refusal:
        model_statement(str(model_dir))
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize("uri", ["nowhere", "models:/nothing@champion"])
def test_no_model_is_one_sentence(in_tracked, uri):
    with pytest.raises(ModelError):
        model_statement(uri)
