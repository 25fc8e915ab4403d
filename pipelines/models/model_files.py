"""A fitted recipe on disk: ``model.skops``, and ``terrain_model.json`` with its checksum beside it.

Models are loaded by skops with the fixed list of types below and nothing else, so that a file cannot bring
code of its own; the checksum distinguishes a damaged file from an intact one.
"""

from __future__ import annotations

import hashlib
import io as streams
import json
import zipfile
from pathlib import Path
from typing import NamedTuple

from features.windows import Layout, WindowRule
from pipelines.models.recipes import WindowPipeline
from pipelines.models.results import ModelInfo
from pipelines.reporting.json_file import as_json
from terrain.errors import ConfigError, DataError, ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import MAX_JSON_BYTES, parse_json
from terrain.files.names import MAX_NAME, printable, shown
from terrain.files.regular import MEBIBYTE, check_inside, read_regular

MODEL_FILE = "model.skops"
INFO_FILE = "terrain_model.json"
INFO_VERSION = 1
INFO_KEYS = {"window_s", "stride_s", "steady", "classes", "channels", "rate_hz", "run_digests"}

MAX_MODEL_BYTES = 256 * MEBIBYTE
"""Of a model as it lies on disk; those of this package have some MiB."""

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of all that a model's archive unpacks to: megabytes of zeros pack to kilobytes."""

TRUSTED_TYPES: tuple[str, ...] = (
    "builtins.frozenset",
    "features.cross_channel.Feature",
    "features.extractor.FeatureExtractor",
    "features.windows.Layout",
    "numpy.clip",
    "numpy.dtype",
    "pipelines.models.recipes.WindowPipeline",
    "terrain.classify.svm.Candidate",
    "terrain.classify.svm.GroupedSVC",
    "terrain.classify.svm.f_score",
)
"""Types beyond those that skops trusts itself which a model of this package may hold."""


_INFO_ERRORS = (TypeError, KeyError, AttributeError, ValueError, ArithmeticError)
"""What a document of another form, or one with impossible numbers, leads to."""


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut."""

    recipe: WindowPipeline
    info: ModelInfo

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return self.info.layout

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut for this model."""
        return self.info.rule


def write_info(folder: Path, info: ModelInfo) -> None:
    """Write ``terrain_model.json`` beside a ``model.skops``, with the checksum of the latter."""
    sha256 = hashlib.sha256((folder / MODEL_FILE).read_bytes()).hexdigest()
    content = {"version": INFO_VERSION, "sha256": sha256, **as_json(info)}
    atomic_write(folder / INFO_FILE, json.dumps(content, indent=2, sort_keys=True) + "\n")


def read_model(folder: Path) -> TerrainModel:
    """Read a model folder.

    Raises
    ------
    ModelError
        if it is no model of this package, is damaged, or holds a type that is not on the list.
    """
    file, info_file = folder / MODEL_FILE, folder / INFO_FILE
    if not file.is_file() or not info_file.is_file():
        raise ModelError(f"{folder}: holds no model of this package ({MODEL_FILE} and {INFO_FILE})")
    for each in (file, info_file):
        check_inside(each, folder, str(each), ModelError)
    try:
        document = parse_json(read_regular(info_file, str(info_file), ModelError, MAX_JSON_BYTES))
        version, expected = document.pop("version"), document.pop("sha256")
        missing = INFO_KEYS - set(document)
    except _INFO_ERRORS as error:
        raise _damaged(info_file, error) from error
    if version != INFO_VERSION or missing:
        raise ModelError(f"{info_file}: has version {shown(version)}; version {INFO_VERSION} is read here")
    content = read_regular(file, str(file), ModelError, MAX_MODEL_BYTES)
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ModelError(f"{file}: is damaged (SHA-256 {found[:12]}..., {str(expected)[:12]}... expected)")
    try:
        model = TerrainModel(_load(file, content), ModelInfo.from_json(document))
        for stream in model.layout.channels:
            model.layout.n_samples(stream, model.rule.length_s)
    except (*_INFO_ERRORS, ConfigError, DataError) as error:
        raise _damaged(info_file, error) from error
    return model


def _damaged(info_file: Path, error: Exception) -> ModelError:
    return ModelError(f"{info_file}: is damaged ({_words(error)})")


def _words(error: Exception) -> str:
    return printable(" ".join(str(error).split())[:200])


def _load(file: Path, content: bytes) -> WindowPipeline:
    from skops import io

    try:
        _check_archive(file, content)
        foreign = sorted(set(io.get_untrusted_types(data=content)) - set(TRUSTED_TYPES))
        if foreign:
            name = printable(foreign[0][:MAX_NAME])
            raise ModelError(f"{file}: holds {name}, a type that models of this package do not hold")
        recipe = io.loads(content, trusted=list(TRUSTED_TYPES))
    except ModelError:
        raise
    except Exception as error:  # skops, numpy and scikit-learn raise whatever a damaged archive leads them to
        raise ModelError(f"{file}: cannot be loaded ({_words(error)})") from error
    if not isinstance(recipe, WindowPipeline):
        raise ModelError(f"{file}: holds a {type(recipe).__name__}, not a recipe of this package")
    if not hasattr(recipe[0], "layout_"):
        raise ModelError(f"{file}: holds a recipe that was never fitted")
    return recipe


def _check_archive(file: Path, content: bytes) -> None:
    with zipfile.ZipFile(streams.BytesIO(content)) as archive:
        unpacked_bytes = sum(entry.file_size for entry in archive.infolist())
    if unpacked_bytes > MAX_UNPACKED_BYTES:
        raise ModelError(f"{file}: unpacks to {unpacked_bytes} bytes, {MAX_UNPACKED_BYTES} are read")
