"""Code of one's own is run by a model only where its module was trusted by name."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.learn.classifier import TerrainClassifier
from pipelines.learn.model_file import read_files, read_model, seal
from pipelines.learn.recipes import load_named
from pipelines.learn.trust import check_trusted, remember, trust_file
from terrain.errors import ConfigError, ModelError, TerrainError

FIELD = """
from os import system

import numpy as np
from pathlib import Path
from sklearn.neighbors import NearestCentroid

Path("imported").touch()

class Nearest(NearestCentroid):
    pass

class Peak:
    __name__ = "peak"

    def __init__(self, channel):
        self.channel = channel

    def __call__(self, window):
        return np.abs(window["imu", self.channel]).max()

def roughness(window):
    return np.abs(np.diff(window["imu", "accel_z_mps2"])).mean()
"""


@pytest.fixture
def field(tmp_path, monkeypatch):
    """A module ``field_code`` of the current folder, which leaves a mark when it is imported, and what forgets it."""
    (tmp_path / "field_code.py").write_text(FIELD, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "configuration"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)

    def forget():
        sys.modules.pop("field_code", None)
        (tmp_path / "imported").unlink(missing_ok=True)
        return tmp_path / "imported"

    forget()  # of another test
    yield forget
    forget()


@pytest.fixture(scope="module")
def fitted(windows, tmp_path_factory):
    """A model with an estimator, a function and an object of the module, and its probabilities."""
    place = tmp_path_factory.mktemp("fitted")
    (place / "field_code.py").write_text(FIELD, encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(sys, "dont_write_bytecode", True)
        functions = (load_named("field_code:roughness"), load_named("field_code:Peak")("gyro_x_radps"))
        model = TerrainClassifier(load_named("field_code:Nearest")(), functions=functions).fit(windows)
        return model.save(place / "model"), model.predict_proba(windows)


@pytest.fixture
def saved(fitted, field, tmp_path):
    """That model beside a module of the test's own, and its probabilities."""
    load_named("field_code:Nearest")
    return Path(shutil.copytree(fitted[0], tmp_path / "model")), fitted[1]


def test_nothing_is_imported_until_the_module_is_trusted_and_then_all_is_the_same(field, saved, windows):
    folder, probability = saved
    names = ("field_code.Nearest", "field_code.Peak", "field_code.roughness")
    assert read_files(folder)[0].own_code == names
    mark = field()
    sys.path.remove(str(folder.parent))
    with pytest.raises(ModelError) as refusal:
        TerrainClassifier.load(folder)
    assert str(folder.parent) not in sys.path  # nor is anything else of the folder found
    assert str(refusal.value) == (
        f"{folder}: it needs code of its own, field_code.Nearest, which is run only where you trust it: "
        "--trust field_code, once, or trust=('field_code',) in Python"
    )
    assert not mark.exists()
    again = TerrainClassifier.load(folder, trust=["field_code"])
    assert mark.exists()
    assert np.array_equal(again.predict_proba(windows), probability)
    assert len(again.functions) == 2
    with pytest.raises(ModelError, match="only where you trust it"):
        read_model(folder)  # an argument is not remembered
    remember(["field_code"])
    assert json.loads(trust_file().read_text()) == {"field_code": str(folder.parent / "field_code.py")}
    assert np.array_equal(read_model(folder).recipe.predict_proba(windows), probability)


def test_a_file_of_the_same_name_elsewhere_is_not_the_one_that_was_trusted(field, saved, monkeypatch):
    folder, _ = saved
    remember(["field_code.roughness"])
    mark = field()
    elsewhere = folder.parent / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "field_code.py").write_text("raise SystemExit('run')", encoding="utf-8")
    monkeypatch.chdir(elsewhere)
    monkeypatch.setattr(sys, "path", [each for each in sys.path if each != str(folder.parent)])
    with pytest.raises(ModelError, match="only where you trust it"):
        read_model(folder)
    assert not mark.exists()


def test_an_installed_module_finds_nothing_in_the_current_folder_nor_a_folder_that_was_not_trusted(
    field, saved, monkeypatch
):
    folder, _ = saved
    mark, stranger = field(), folder.parent / "stranger"
    for module in ("field_code", "several"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    installed = folder.parent / "installed"
    for each in (stranger / "several", installed / "several"):
        each.mkdir(parents=True)
    (folder.parent / "field_code.py").rename(installed / "field_code.py")
    with (installed / "field_code.py").open("a", encoding="utf-8") as file:
        file.write("\ntry:\n    import faster\nexcept ImportError:\n    faster = None\n")
    (stranger / "faster.py").write_text("from pathlib import Path\nPath('run').touch()", encoding="utf-8")
    monkeypatch.chdir(stranger)
    monkeypatch.setattr(
        sys, "path", [*(each for each in sys.path if each != str(folder.parent)), str(installed)]
    )
    remember(["field_code", "several"])
    read_model(folder)
    assert (stranger / "imported").exists()
    assert not mark.exists()
    assert not (stranger / "run").exists()
    check_trusted(["several.part.Thing"])
    sys.path.append(str(stranger))  # another part of a package without a file of its own
    with pytest.raises(ModelError, match="only where you trust it"):
        check_trusted(["several.part.Thing"])


def test_a_script_that_ends_itself_is_one_sentence(field, saved, tmp_path):
    folder, _ = saved
    field()
    (tmp_path / "field_code.py").write_text("raise SystemExit('usage: field_code')", encoding="utf-8")
    with pytest.raises(ModelError, match=r"field_code\.Nearest cannot be imported: usage: field_code"):
        read_model(folder, ["field_code"])
    with pytest.raises(ConfigError, match="'field_code' cannot be imported: usage: field_code"):
        load_named("field_code:Nearest")


@pytest.mark.parametrize(
    ("own", "sentence"),
    [
        (("field_code.Nearest", "field_code.Peak"), r"holds field_code\.roughness, a type that models"),
        (("os.mkdir",), "needs code of its own, os.mkdir, which is run only where you trust"),
        (("field_code.system",), "field_code.system is none of module field_code"),
        (("field_code.absent",), "field_code.absent cannot be imported: module 'field_code' has no"),
        (("field_code",), "field_code cannot be imported"),
        (("a\nb" * 900,), r"a\\nb.* only where you trust it"),
    ],
)
def test_what_a_stranger_writes_into_the_manifest_runs_nothing_else(field, saved, own, sentence):
    folder, _ = saved
    info, _ = read_files(folder)
    own = own if "field_code.Nearest" in own else (*info.own_code, *own)
    seal(folder, replace(info, own_code=own))
    field()
    with pytest.raises(ModelError, match=sentence) as refusal:
        read_model(folder, ["field_code", "os"])
    assert str(refusal.value).isprintable()


@pytest.mark.usefixtures("field")
def test_what_cannot_be_trusted_is_one_sentence():
    for names, sentence in (
        (["os"], "module 'os' is not trusted: it is none of your own"),
        (["sklearn.tree"], "module 'sklearn' is not trusted"),
        (["../x"], "is not trusted"),
        (["no_such_module"], "there is no module 'no_such_module' to trust"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            remember(names)
    assert not trust_file().exists()
    trust_file().parent.parent.write_text("a file where the folder would be")
    with pytest.raises(TerrainError, match="cannot be written"):
        remember(["field_code"])
    trust_file().parent.parent.unlink()
    trust_file().parent.mkdir(parents=True)
    trust_file().write_text("[3]")
    with pytest.raises(ConfigError, match="is no table of modules and their files"):
        remember(["field_code"])
