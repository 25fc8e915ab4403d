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
from typing import TYPE_CHECKING, Any, NamedTuple

from features.windows import Layout, WindowRule, cut_windows
from pipelines.models.lean import NUMBERS_FILE, LeanRecipe, read_numbers
from pipelines.models.novelty_file import NOVELTY_FILE, read_novelty
from pipelines.models.results import ModelInfo
from pipelines.reporting.json_file import as_json
from terrain.classify.novelty_numbers import NoveltyNumbers
from terrain.classify.support import SupportTable
from terrain.classify.terrain_filter import TerrainFilter
from terrain.errors import ConfigError, DataError, ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import MAX_JSON_BYTES, parse_json
from terrain.files.names import MAX_NAME, name_fault, printable, shown
from terrain.files.regular import MEBIBYTE, check_inside, read_regular

if TYPE_CHECKING:
    from pipelines.learn.recipes import WindowPipeline

MODEL_FILE = "model.skops"
INFO_FILE = "terrain_model.json"
INFO_VERSION = 2
"""1: probabilities of votes of the pairs of classes; 2: of their margins."""

UNCHECKED = (MODEL_FILE, NUMBERS_FILE, INFO_FILE, "MLmodel")
"""Files that have a checksum of their own, the one that holds the checksums, and one that MLflow writes to
afterwards and that is not read here."""

CHECKSUMS = ("sha256", "numbers_sha256", "files_sha256")
INFO_KEYS = {"window_s", "stride_s", "steady", "classes", "channels", "rate_hz", "run_digests"}

MAX_MODEL_BYTES = 256 * MEBIBYTE
"""Of a model as it lies on disk; those of this package have some MiB."""

MAX_OTHER_FILES = 64
"""Files beside a model; those of this package have half a dozen."""

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of all that a model's archive unpacks to: megabytes of zeros pack to kilobytes."""

TRUSTED_TYPES: tuple[str, ...] = (
    "builtins.frozenset",
    "features.cross_channel.Feature",
    "features.extractor.FeatureExtractor",
    "features.response.ResponseExtractor",
    "features.sample_extractor.SampleExtractor",
    "features.windows.Layout",
    "numpy.clip",
    "numpy.dtype",
    "pipelines.learn.recipes.WindowPipeline",
    "terrain.classify.augment.Augmentation",
    "terrain.classify.grouped_network.GroupedNetwork",
    "terrain.classify.grouped_network.NetworkChoice",
    "terrain.classify.grouped_network.Trial",
    "terrain.classify.network_numbers.BranchNumbers",
    "terrain.classify.network_numbers.NetworkNumbers",
    "terrain.classify.network_numbers.SampleColumns",
    "terrain.classify.ground_response.GroundResponse",
    "terrain.classify.regime_process.Process",
    "terrain.classify.response.GroupedResponse",
    "terrain.classify.response.ResponseChoice",
    "terrain.classify.response.ResponseColumns",
    "terrain.classify.stack.GroupedStack",
    "terrain.classify.stack.StackChoice",
    "terrain.classify.svm.Candidate",
    "terrain.classify.svm.GroupedSVC",
    "terrain.classify.svm.f_score",
)
"""Types beyond those that skops trusts itself which a model of this package may hold."""


_INFO_ERRORS = (TypeError, KeyError, AttributeError, ValueError, ArithmeticError)
"""What a document of another form, or one with impossible numbers, leads to."""


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)`` and ``classes_``: the scikit-learn pipeline, or its numbers.
    ``novelty`` and ``support`` are None of models of earlier releases, and of training runs that give none;
    ``over_time`` is the filter of its outputs, where they are to be filtered.
    """

    recipe: WindowPipeline | LeanRecipe
    info: ModelInfo
    novelty: NoveltyNumbers | None = None
    support: SupportTable | None = None
    over_time: TerrainFilter | None = None

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return self.info.layout

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut for this model."""
        return self.info.rule


def write_info(folder: Path, info: ModelInfo) -> None:
    """Write ``terrain_model.json`` beside a model's files, with the checksums of all of them."""
    content = {"version": INFO_VERSION, "sha256": _sha256(folder / MODEL_FILE), **as_json(info)}
    if (folder / NUMBERS_FILE).is_file():
        content["numbers_sha256"] = _sha256(folder / NUMBERS_FILE)
    others = sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in UNCHECKED)
    content["files_sha256"] = {path.relative_to(folder).as_posix(): _sha256(path) for path in others}
    atomic_write(folder / INFO_FILE, json.dumps(content, indent=2, sort_keys=True) + "\n")


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def read_model(folder: Path) -> TerrainModel:
    """Read a model folder.

    Raises
    ------
    ModelError
        if it is no model of this package, is damaged, or holds a type that is not on the list.
    """
    document = _read_info(folder)
    file = folder / MODEL_FILE
    content = _checked(file, MAX_MODEL_BYTES, document["sha256"])
    if "numbers_sha256" in document:
        _numbers_content(folder, document)
    _check_others(folder, document)
    return _model(_load(file, content), folder, document)


def read_lean_model(folder: Path) -> TerrainModel:
    """Read a model folder for a service: its numbers where they are there, without scikit-learn.

    Raises
    ------
    ModelError
        as :func:`read_model`.
    """
    document = _read_info(folder)
    file = folder / NUMBERS_FILE
    if "numbers_sha256" not in document:  # of an earlier release, or of a recipe without numbers
        return read_model(folder)
    _checked(folder / MODEL_FILE, MAX_MODEL_BYTES, document["sha256"])  # damaged in part is damaged
    content = _numbers_content(folder, document)
    _check_others(folder, document)
    info = _info(folder, document)
    try:
        recipe = read_numbers(content, info)
    except (*_INFO_ERRORS, DataError) as error:
        raise ModelError(f"{file}: cannot be loaded ({_words(error)})") from error
    return _model(recipe, folder, document)


def _read_info(folder: Path) -> dict[str, Any]:
    """Return the document beside a model, whose version and keys are checked."""
    file, info_file = folder / MODEL_FILE, folder / INFO_FILE
    if not file.is_file() or not info_file.is_file():
        raise ModelError(f"{folder}: holds no model of this package ({MODEL_FILE} and {INFO_FILE})")
    for each in (file, info_file):
        check_inside(each, folder, str(each), ModelError)
    try:
        document: dict[str, Any] = parse_json(
            read_regular(info_file, str(info_file), ModelError, MAX_JSON_BYTES)
        )
        version, _ = document["version"], document["sha256"]
        missing = INFO_KEYS - set(document)
    except _INFO_ERRORS as error:
        raise _damaged(info_file, error) from error
    if version != INFO_VERSION or missing:
        raise ModelError(f"{info_file}: has version {shown(version)}; version {INFO_VERSION} is read here")
    return document


def _checked(file: Path, most_bytes: int, expected: Any) -> bytes:
    content = read_regular(file, str(file), ModelError, most_bytes)
    found = hashlib.sha256(content).hexdigest()
    if found != expected:
        raise ModelError(f"{file}: is damaged (SHA-256 {found[:12]}..., {str(expected)[:12]}... expected)")
    return content


def _numbers_content(folder: Path, document: dict[str, Any]) -> bytes:
    file = folder / NUMBERS_FILE
    check_inside(file, folder, str(file), ModelError)
    return _checked(file, MAX_MODEL_BYTES, document["numbers_sha256"])


def _check_others(folder: Path, document: dict[str, Any]) -> None:
    """Refuse a folder in which another file than the model is damaged, missing or a link out of it."""
    listed = document.get("files_sha256", {})  # none of an earlier release
    if not isinstance(listed, dict) or len(listed) > MAX_OTHER_FILES:
        raise _damaged(folder / INFO_FILE, ValueError("files_sha256 is no list of files"))
    for name, expected in listed.items():
        fault = next(filter(None, (name_fault(part) for part in name.split("/"))), None)
        if fault is not None:
            raise _damaged(folder / INFO_FILE, ValueError(f"a file {shown(name)} {fault}"))
        file = folder / name
        check_inside(file, folder, str(file), ModelError)
        _checked(file, MAX_MODEL_BYTES, expected)


def _info(folder: Path, document: dict[str, Any]) -> ModelInfo:
    kept = {name: value for name, value in document.items() if name not in ("version", *CHECKSUMS)}
    try:
        info = ModelInfo.from_json(kept)
        for stream in info.layout.channels:
            info.layout.n_samples(stream, info.rule.length_s)
    except (*_INFO_ERRORS, ConfigError, DataError) as error:
        raise _damaged(folder / INFO_FILE, error) from error
    return info


def _model(recipe: WindowPipeline | LeanRecipe, folder: Path, document: dict[str, Any]) -> TerrainModel:
    info = _info(folder, document)
    novelty = support = None
    try:
        if info.support is not None:
            support = SupportTable.from_json(info.support, info.classes)
    except DataError as error:
        raise _damaged(folder / INFO_FILE, error) from error
    file = folder / NOVELTY_FILE
    if NOVELTY_FILE in document.get("files_sha256", {}):
        try:
            novelty = read_novelty(
                read_regular(file, str(file), ModelError, MAX_MODEL_BYTES), len(info.classes)
            )
            _check_features(novelty, recipe, info)
        except DataError as error:
            raise ModelError(f"{file}: {_words(error)}") from error
    return TerrainModel(recipe, info, novelty, support)


def _check_features(novelty: NoveltyNumbers, recipe: WindowPipeline | LeanRecipe, info: ModelInfo) -> None:
    """Refuse a novelty score of other features than those of the model."""
    nothing = cut_windows([], info.rule, layout=info.layout).windows
    n_features = recipe.matrix.of(nothing).shape[1]
    if novelty.settings[1] != n_features:
        raise DataError(f"is of {novelty.settings[1]:.0f} features; the model has {n_features}")


def _damaged(info_file: Path, error: Exception) -> ModelError:
    return ModelError(f"{info_file}: is damaged ({_words(error)})")


def _words(error: Exception) -> str:
    return printable(" ".join(str(error).split())[:200])


def _load(file: Path, content: bytes) -> WindowPipeline:
    from skops import io

    from pipelines.learn.recipes import WindowPipeline

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
