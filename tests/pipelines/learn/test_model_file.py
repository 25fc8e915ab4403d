"""What is read back is what was written; what is damaged, foreign or manipulated is one sentence."""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.preprocessing import FunctionTransformer, StandardScaler
from skops import io as skops_io

from features.recipes import WindowPipeline, make_recipe
from features.windows import SteadyMotion, WindowRule, cut_windows
from pipelines.learn.model_file import (
    MANIFEST_FILE,
    MODEL_FILE,
    TRUSTED_TYPES,
    read_files,
    read_model,
    seal,
    write_model,
)
from terrain.errors import ModelError


@pytest.fixture
def put(model_dir):
    """What puts other bytes in place of the model, with a checksum that fits them."""
    info, _ = read_files(model_dir)

    def put(content):
        (model_dir / MODEL_FILE).write_bytes(content)
        seal(model_dir, info)

    return put


def test_a_saved_model_predicts_the_same_to_the_last_bit(model_dir, runs):
    model = read_model(model_dir)
    windows = cut_windows(runs, model.info.rule).windows
    live = make_recipe("svm").fit(windows, windows.terrain.astype(str))
    assert np.array_equal(model.recipe.predict_proba(windows), live.predict_proba(windows))
    assert model.recipe.classes_.tolist() == list(model.info.classes) == ["ASPHALT", "GRASS", "GRAVEL"]
    assert model.info.rule == WindowRule(2.0, None, SteadyMotion())
    assert set(skops_io.get_untrusted_types(file=model_dir / MODEL_FILE)) <= set(TRUSTED_TYPES)


@pytest.mark.parametrize("place", [0.0, 0.5, 0.999])
def test_one_flipped_bit_anywhere_is_seen(model_dir, place):
    content = bytearray((model_dir / MODEL_FILE).read_bytes())
    content[int(place * len(content))] ^= 1
    (model_dir / MODEL_FILE).write_bytes(content)
    with pytest.raises(ModelError, match=r"model\.skops: is damaged \(SHA-256 .* expected\)"):
        read_model(model_dir)


def test_damage_that_the_checksum_covers_up_ends_in_one_sentence(model_dir, put):
    """Of the archive, and of what lies in it, which its own checksums then do not cover."""
    whole = (model_dir / MODEL_FILE).read_bytes()
    with zipfile.ZipFile(model_dir / MODEL_FILE) as source:
        members = {name: source.read(name) for name in source.namelist()}
    small = sorted(members, key=lambda name: len(members[name]))[:40]
    rng, refusals = np.random.default_rng(3), []
    for number in range(40):
        inside = number % 2 == 1
        hit = small[rng.integers(len(small))]
        content = bytearray(members[hit] if inside else whole[: rng.integers(len(whole))])
        for place in rng.integers(min(len(content), 128) if inside else max(len(content), 1), size=3):
            content[place : place + 1] = bytes([rng.integers(256)])
        if inside:
            packed = io.BytesIO()
            with zipfile.ZipFile(packed, "w") as target:
                for name, member in members.items():
                    target.writestr(name, bytes(content) if name == hit else member)
            content = packed.getvalue()
        put(bytes(content))
        try:
            read_model(model_dir)
        except ModelError as error:
            refusals.append(str(error))
    assert len(refusals) > 25  # bytes that carry nothing may change unseen; nothing else is ever raised
    assert all(sentence.isprintable() for sentence in refusals)


def whole(recipe):
    return skops_io.dumps(WindowPipeline(recipe))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (lambda: skops_io.dumps(OTHER), "holds a LogisticRegression, not a recipe of this package"),
        (lambda: skops_io.dumps({"recipe": 3, "novelty": OTHER}), "holds a int, not a recipe"),
        (lambda: skops_io.dumps(make_recipe("svm")), "holds a recipe that was never fitted"),
        (
            lambda: whole([("scale", StandardScaler()), ("last", OTHER)]),
            "holds a recipe that was never fitted",
        ),
        (
            lambda: whole(
                [("make", FunctionTransformer(os.mkdir, kw_args={"path": "called"})), ("last", OTHER)]
            ),
            r"holds posix\.mkdir, a type that models of this package do not hold",
        ),
        (lambda: archive(b" " * (1 << 20), 17), "unpacks to"),
        (lambda: archive(b"[" * 100_000, 1), "cannot be loaded"),
    ],
)
def test_what_is_no_model_of_this_package_is_named_and_never_called(
    model_dir, put, tmp_path, monkeypatch, content, sentence
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipelines.learn.model_file.MAX_UNPACKED_BYTES", 1 << 24)
    put(content())
    with pytest.raises(ModelError, match=sentence):
        read_model(model_dir)
    assert not (tmp_path / "called").exists()


OTHER = LogisticRegression().fit([[0.0], [1.0]], [0, 1])


def archive(content, n):
    """Return an archive of a schema and further members of the same content."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target:
        for number in range(n):
            target.writestr(f"{number}.bin" if number else "schema.json", content)
    return packed.getvalue()


class Bomb:
    """Leaves a mark when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.mkdir, (str(self.marker),)


def test_nothing_is_ever_unpickled(model_dir, put, tmp_path):
    marker = tmp_path / "unpickled"
    bomb = pickle.dumps(Bomb(marker))
    put(bomb)
    with pytest.raises(ModelError, match="cannot be loaded"):
        read_model(model_dir)
    # Arrays inside a model file are files of their own, and one of objects is a pickle.
    objects = io.BytesIO()
    np.save(objects, np.array([Bomb(marker)], dtype=object), allow_pickle=True)
    changed = io.BytesIO()
    put(whole := skops_io.dumps(np.arange(3.0)))
    with zipfile.ZipFile(io.BytesIO(whole)) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            target.writestr(name, objects.getvalue() if name.endswith(".npy") else source.read(name))
    put(changed.getvalue())
    with pytest.raises(ModelError, match="cannot be loaded"):
        read_model(model_dir)
    assert not marker.exists()
    pickle.loads(bomb)
    assert marker.is_dir()  # the test can fail


@pytest.mark.parametrize("missing", [MODEL_FILE, MANIFEST_FILE])
def test_a_folder_that_lacks_a_file_holds_no_model(model_dir, missing):
    (model_dir / missing).unlink()
    with pytest.raises(
        ModelError, match=r"holds no model of this package \(model\.skops and terrain_model\.json\)"
    ):
        read_model(model_dir)


def changed(document, **info):
    return json.dumps(document | {"info": document["info"] | info})


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda it: "{", "is damaged"),
        (lambda it: "[]", "is damaged"),
        (lambda it: json.dumps({"version": 4, "info": it["info"]}), r"is damaged \(files: Field required\)"),
        (lambda it: json.dumps(it | {"version": 99}), "has version 99; version 4 is read here"),
        (lambda it: json.dumps(it | {"version": ["x"] * 10**5}), "has version"),
        (lambda it: json.dumps(it | {"files": {}}), "its list of files is not that of a model"),
        (lambda it: json.dumps(it | {"files": {**it["files"], "../x": "a"}}), "its list of files is not"),
        (lambda it: json.dumps(it | {"files": {MODEL_FILE: "5"}}), r"is damaged \(SHA-256"),
        (lambda it: changed(it, window_s="two"), "is damaged"),
        (lambda it: changed(it, classes=["grass", 3]), r"info\.classes\.1: Input should be a valid string"),
        (lambda it: changed(it, classes="grass"), "info.classes: Input should be a valid"),
        (lambda it: changed(it, classes=["ice", "mud", "sand"]), "its classes are not those of the manifest"),
        (lambda it: changed(it, window_s=-2.0), r"is damaged \(window length_s is -2\.0"),
        (lambda it: changed(it, window_s=10**400), "more than 64 bits"),
        (lambda it: changed(it, window_s=float("nan")), "holds NaN, finite numbers"),
        (lambda it: changed(it, steady={"a\nb": 1}), "is damaged"),
        (lambda it: changed(it, rate_hz=dict.fromkeys(it["info"]["rate_hz"], 1e308)), "is damaged"),
        (lambda it: changed(it, channels={"imu": ["gyro_x_radps"]}), "cannot be loaded"),
        (lambda it: "[" * 100_000, r"is damaged \(is nested deeper than 32 levels\)"),
    ],
)
def test_a_manifest_of_a_stranger_is_one_sentence(model_dir, change, fault):
    file = model_dir / MANIFEST_FILE
    file.write_text(change(json.loads(file.read_text())))
    with pytest.raises(ModelError, match=fault) as error:
        read_model(model_dir)
    assert str(error.value).isprintable()
    assert len(str(error.value)) < 600


@pytest.mark.parametrize("name", [MODEL_FILE, MANIFEST_FILE])
def test_a_link_out_of_the_model_folder_is_refused(model_dir, tmp_path, name):
    (model_dir / name).rename(tmp_path / name)
    (model_dir / name).symlink_to(tmp_path / name)
    with pytest.raises(ModelError, match="is a link that leads out of"):
        read_model(model_dir)
    (model_dir / name).unlink()
    (tmp_path / name).rename(model_dir / name)
    (tmp_path / "link").symlink_to(model_dir)
    read_model(tmp_path / "link")


def test_an_estimator_of_ones_own_is_refused_before_it_is_stored(model_dir, tmp_path):
    model = read_model(model_dir)
    recipe = WindowPipeline([*model.recipe.steps[:-1], ("classifier", Foreign())])
    with pytest.raises(ModelError, match="Foreign cannot be stored: a model file holds only types"):
        write_model(tmp_path, model._replace(recipe=recipe))
    assert not list(tmp_path.glob("*.*"))


class Foreign(LogisticRegression):
    """Of no library."""
