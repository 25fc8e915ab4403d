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

from features.recipes import WindowPipeline, make_recipe
from features.windows import SteadyMotion, WindowRule
from pipelines.learn.model_file import (
    MANIFEST_FILE,
    MODEL_FILE,
    TRUSTED_TYPES,
    read_files,
    read_model,
    seal,
    skops_io,
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


def test_a_saved_model_predicts_the_same_to_the_last_bit(model_dir, windows, model):
    live = make_recipe("svm").fit(windows, windows.terrain.astype(str))
    assert np.array_equal(model.recipe.predict_proba(windows), live.predict_proba(windows))
    assert model.recipe.classes_.tolist() == list(model.info.classes) == ["ASPHALT", "GRASS", "GRAVEL"]
    assert model.info.rule == WindowRule(2.0, None, SteadyMotion())
    assert set(skops_io().get_untrusted_types(file=model_dir / MODEL_FILE)) <= set(TRUSTED_TYPES)


def test_laws_of_response_are_kept_and_those_that_do_not_fit_are_refused(model_dir, model, put):
    held = skops_io().loads((model_dir / MODEL_FILE).read_bytes(), trusted=list(TRUSTED_TYPES))
    for name, value in zip(model.answers._fields, model.answers, strict=True):
        np.testing.assert_array_equal(getattr(held["answers"], name), value)
    for wrong, sentence in (
        (model.answers._replace(classes=("ICE", "MUD", "TAR")), "of other terrains"),
        (model.answers._replace(noise=model.answers.noise[:-1]), "the noise of the laws of response are not"),
        (model.novelty, "holds a Novelty, Answers is read"),
    ):
        put(skops_io().dumps(held | {"answers": wrong}))
        with pytest.raises(ModelError, match=sentence):
            read_model(model_dir)


def test_one_flipped_bit_anywhere_is_seen(model_dir):
    whole = (model_dir / MODEL_FILE).read_bytes()
    for place in (0, len(whole) // 2, len(whole) - 1):
        content = bytearray(whole)
        content[place] ^= 1
        (model_dir / MODEL_FILE).write_bytes(content)
        with pytest.raises(ModelError, match=r"model\.skops: is damaged \(SHA-256 .* expected\)"):
            read_model(model_dir)


def archive(members):
    """Return an archive of contents by name."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target:
        for name, content in members.items():
            target.writestr(name, content)
    return packed.getvalue()


def members_of(content):
    with zipfile.ZipFile(io.BytesIO(content)) as source:
        return {name: source.read(name) for name in source.namelist()}


@pytest.mark.slow
def test_damage_that_the_checksum_covers_up_ends_in_one_sentence(model_dir, put):
    """Of the archive, and of what lies in it, which its own checksums then do not cover."""
    whole = (model_dir / MODEL_FILE).read_bytes()
    members = members_of(whole)
    small = sorted(members, key=lambda name: len(members[name]))[:40]
    rng, refusals = np.random.default_rng(3), []
    for inside in 20 * [False, True]:
        hit = small[rng.integers(len(small))]
        content = bytearray(members[hit] if inside else whole[: rng.integers(len(whole))])
        for place in rng.integers(min(len(content), 128) if inside else max(len(content), 1), size=3):
            content[place : place + 1] = bytes([rng.integers(256)])
        put(archive(members | {hit: bytes(content)}) if inside else bytes(content))
        try:
            read_model(model_dir)
        except ModelError as error:
            refusals.append(str(error))
    assert len(refusals) > 25  # bytes that carry nothing may change unseen; nothing else is ever raised
    assert all(sentence.isprintable() for sentence in refusals)


OTHER = LogisticRegression().fit([[0.0], [1.0]], [0, 1])
CALLED = "called"


class Bomb:
    """Leaves a mark when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, (CALLED,)


def pickled_array():
    """Return a model file with an array of objects, which is a pickle in a file of its own."""
    objects = io.BytesIO()
    np.save(objects, np.array([Bomb()], dtype=object), allow_pickle=True)
    members = members_of(skops_io().dumps(np.arange(3.0)))
    return archive({name: objects.getvalue() if name.endswith(".npy") else members[name] for name in members})


def recipe(first):
    return skops_io().dumps(WindowPipeline([("first", first), ("last", OTHER)]))


def test_what_is_no_model_of_this_package_is_named_and_never_called(model_dir, put, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pipelines.learn.model_file.MAX_UNPACKED_BYTES", 1 << 24)
    calls = recipe(FunctionTransformer(os.mkdir, kw_args={"path": CALLED}))
    for content, sentence in (
        (skops_io().dumps(OTHER), "holds a LogisticRegression, not a recipe of this package"),
        (skops_io().dumps({"recipe": 3, "novelty": OTHER}), "holds a int, not a recipe"),
        (skops_io().dumps(make_recipe("svm")), "holds a recipe that was never fitted"),
        (recipe(StandardScaler()), "holds a recipe that was never fitted"),
        (calls, r"holds posix\.mkdir, a type that models of this package do not hold"),
        (pickle.dumps(Bomb()), "cannot be loaded"),
        (pickled_array(), "cannot be loaded"),
        (archive({f"{number}.bin": b" " * (1 << 20) for number in range(17)}), "unpacks to"),
        (archive({"schema.json": b"[" * 100_000}), "cannot be loaded"),
    ):
        put(content)
        with pytest.raises(ModelError, match=sentence):
            read_model(model_dir)
        assert not (tmp_path / CALLED).exists()
    pickle.loads(pickle.dumps(Bomb()))
    assert (tmp_path / CALLED).exists()  # the test can fail


def test_a_manifest_of_a_stranger_is_one_sentence(model_dir):
    file = model_dir / MANIFEST_FILE
    whole = json.loads(file.read_text())
    info, files = whole["info"], whole["files"]
    for change, fault in (
        ("{", "is damaged"),
        ("[]", "is damaged"),
        ("[" * 100_000, r"is damaged \(is nested deeper than 32 levels\)"),
        ({"files": ...}, r"is damaged \(files: Field required\)"),
        ({"version": 99}, "has version 99; version 7 is read here"),
        ({"version": ["x"] * 10**5}, "has version"),
        ({"files": {}}, "its list of files is not that of a model"),
        ({"files": {**files, "../x": "a"}}, "its list of files is not"),
        ({"files": {MODEL_FILE: "5"}}, r"is damaged \(SHA-256"),
        ({"info": info | {"classes": ["ice", "mud", "sand"]}}, "its classes are not those of the manifest"),
        ({"info": info | {"window_s": -2.0}}, r"is damaged \(window length_s is -2\.0"),
        ({"info": info | {"window_s": 10**400}}, "more than 64 bits"),
        ({"info": info | {"window_s": float("nan")}}, "holds NaN, finite numbers"),
        ({"info": info | {"window_s": 1e6}}, r"is damaged \(a window of it has more than 10000000 values"),
        ({"info": info | {"steady": {"a\nb": 1}}}, "is damaged"),
        ({"info": info | {"rate_hz": dict.fromkeys(info["rate_hz"], 1e308)}}, "is damaged"),
        ({"info": info | {"channels": {"imu": ["gyro_x_radps"]}}}, "cannot be loaded"),
    ):
        if not isinstance(change, str):
            change = json.dumps({name: each for name, each in (whole | change).items() if each is not ...})
        file.write_text(change)
        with pytest.raises(ModelError, match=fault) as error:
            read_model(model_dir)
        assert str(error.value).isprintable()
        assert len(str(error.value)) < 600


@pytest.mark.parametrize("name", [MODEL_FILE, MANIFEST_FILE])
def test_a_file_that_is_missing_or_a_link_out_of_the_folder_is_refused(model_dir, tmp_path, name):
    (model_dir / name).rename(tmp_path / name)
    lacks = r"holds no model of this package \(model\.skops and terrain_model\.json\)"
    with pytest.raises(ModelError, match=lacks):
        read_model(model_dir)
    (model_dir / name).symlink_to(tmp_path / name)
    with pytest.raises(ModelError, match="is a link that leads out of"):
        read_model(model_dir)
    (model_dir / name).unlink()
    (tmp_path / name).rename(model_dir / name)
    (tmp_path / "link").symlink_to(model_dir)
    read_model(tmp_path / "link")
