"""A trained model as a folder: ``model.skops``, ``network.onnx`` where it has one, and a manifest.

The scikit-learn part is loaded by skops with the fixed list of types below and nothing else, so that a file
cannot bring code of its own; the network is stored as ONNX, from which its numbers are read.  The manifest,
written last, says how windows must be cut and holds the checksums of all files: a damaged folder is
distinguished from an intact one.
"""

from __future__ import annotations

import copy
import hashlib
import io as streams
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict

from features.samples import is_centred
from features.windows import Layout, SteadyMotion, WindowRule
from terrain import __version__
from terrain.classify.network_numbers import check_network
from terrain.classify.network_onnx import network_onnx, numbers_of_onnx
from terrain.classify.novelty_numbers import NoveltyNumbers, check_novelty
from terrain.classify.support import SupportTable
from terrain.classify.terrain_filter import TerrainFilter
from terrain.errors import ConfigError, DataError, ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import MAX_JSON_BYTES, parse_document, parse_json
from terrain.files.names import MAX_NAME, printable, shown
from terrain.files.regular import MEBIBYTE, check_inside, read_regular
from terrain.records import Array, Windows

if TYPE_CHECKING:
    from features.recipes import WindowPipeline

MODEL_FILE, ONNX_FILE, MANIFEST_FILE = "model.skops", "network.onnx", "terrain_model.json"
CARD_FILE, TRAINING_FILE = "model_card.md", "training.json"
FILES = (MODEL_FILE, ONNX_FILE, CARD_FILE, TRAINING_FILE)
"""Files that a manifest may list; what else lies beside them is not read."""

VERSION = 3

MAX_MODEL_BYTES = 256 * MEBIBYTE
"""Of a file as it lies on disk; those of this package have some MiB."""

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of all that a model's archive unpacks to: megabytes of zeros pack to kilobytes."""

TRUSTED_TYPES: tuple[str, ...] = (
    "builtins.frozenset",
    "features.cross_channel.Feature",
    "features.extractor.FeatureExtractor",
    "features.response.ResponseExtractor",
    "features.sample_extractor.SampleExtractor",
    "features.windows.Layout",
    "numpy.dtype",
    "features.recipes.WindowPipeline",
    "terrain.classify.augment.Augmentation",
    "terrain.classify.grouped_network.GroupedNetwork",
    "terrain.classify.grouped_network.NetworkChoice",
    "terrain.classify.grouped_network.Trial",
    "terrain.classify.ground_response.GroundResponse",
    "terrain.classify.network_numbers.SampleColumns",
    "terrain.classify.novelty_numbers.NoveltyNumbers",
    "terrain.classify.own.OwnClassifier",
    "terrain.classify.regime_process.Process",
    "terrain.classify.response.GroupedResponse",
    "terrain.classify.response.ResponseChoice",
    "terrain.classify.response.ResponseColumns",
    "terrain.classify.stack.GroupedStack",
    "terrain.classify.stack.StackChoice",
    "terrain.classify.svm.Candidate",
    "terrain.classify.svm.GroupedSVC",
    "terrain.classify.svm.Preparation",
)
"""Types beyond those that skops trusts itself which a model of this package may hold."""


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """How the training windows of a model were cut, as those of a new log must be, and where they came from.

    Parameters
    ----------
    classes : in the order of the probabilities
    window_s, stride_s, steady : the rule of the windows
    channels, rate_hz : by stream, which a log must have
    run_digests : of each training run
    recipe, signal_sets, seed : what was trained
    data_digest, dataset : of the training runs
    commit, package_version : of the code
    robots : whose runs the training runs were, by name
    filter : that made the streams ``estimator`` and ``slip``; empty where the model uses neither
    evaluation : figures on held-out runs by name, as ``accuracy``; empty where it was not evaluated
    class_ratio : share of each class among the training windows
    run_accuracy : of the windows of each training run when it was held out, by its digest
    support : training runs of each terrain by motion, a :class:`~terrain.classify.support.SupportTable`
    conformal : threshold of the sets of classes; None, as ``support``, where there is none
    """

    classes: tuple[str, ...]
    window_s: float
    stride_s: float | None
    steady: SteadyMotion | None
    channels: Mapping[str, tuple[str, ...]]
    rate_hz: Mapping[str, float]
    run_digests: tuple[str, ...]
    recipe: str = ""
    signal_sets: tuple[str, ...] = ()
    seed: int = 0
    data_digest: str = ""
    dataset: str = ""
    commit: str = ""
    package_version: str = ""
    robots: tuple[str, ...] = ()
    filter: str = ""
    evaluation: Mapping[str, float] = field(default_factory=dict)
    class_ratio: Mapping[str, float] = field(default_factory=dict)
    run_accuracy: Mapping[str, float] = field(default_factory=dict)
    support: Mapping[str, Any] | None = None
    conformal: float | None = None

    @property
    def layout(self) -> Layout:
        """Channels and rates that a log must have."""
        return Layout(self.channels, self.rate_hz)

    @property
    def rule(self) -> WindowRule:
        """How windows must be cut."""
        return WindowRule(self.window_s, self.stride_s, self.steady)


def model_info(layout: Layout, rule: WindowRule, terrain: Array, **known: Any) -> ModelInfo:
    """Return what a model is that was trained on windows of the terrains (n,); what else is known by name."""
    classes, counts = np.unique(terrain.astype(str), return_counts=True)
    return ModelInfo(
        classes=tuple(classes.tolist()),
        window_s=rule.length_s,
        stride_s=rule.stride_s,
        steady=rule.steady,
        channels={stream: tuple(names) for stream, names in layout.channels.items()},
        rate_hz=dict(layout.rate_hz),
        package_version=__version__,
        class_ratio=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        **known,
    )


def window_words(info: ModelInfo) -> str:
    """Return how the windows of a model are cut, in words."""
    motion = "all motion" if info.steady is None else "steady motion"
    return f"{info.window_s:g} s every {info.rule.step_s:g} s, {motion}"


class Manifest(BaseModel):
    """What ``terrain_model.json`` holds: its version, the SHA-256 of each file, and what the model is."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    version: int
    files: dict[str, str]
    info: ModelInfo


class TerrainModel(NamedTuple):
    """A fitted recipe, and how its training windows were cut.

    ``recipe`` has ``predict_proba(windows)`` and ``classes_``.  ``novelty`` and ``support`` are None of
    training runs that give none; ``over_time`` is the filter of its outputs, where they are to be filtered.
    """

    recipe: WindowPipeline
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


def write_model(folder: Path, model: TerrainModel) -> None:
    """Write a model's files into a folder in place of those that lie there, the manifest last.

    Raises
    ------
    ModelError
        if the model holds a type that could not be read back.
    ConfigError
        if it has a network and onnx is not installed.
    """
    from skops import io

    recipe, network = _without_network(model.recipe)
    content = io.dumps({"recipe": recipe, "novelty": model.novelty})
    _refuse_foreign(content)
    for name in (MANIFEST_FILE, *FILES):  # of a model that lay there
        (folder / name).unlink(missing_ok=True)
    atomic_write(folder / MODEL_FILE, content)
    if network is not None:
        classes = [str(name) for name in model.info.classes]
        centred = {
            each.stream: [
                is_centred(each.stream, name, recipe[0].matrix.level_sets) for name in each.channels
            ]
            for each in network.numbers_.columns
        }
        atomic_write(
            folder / ONNX_FILE, network_onnx(network.numbers_, classes, model.info.window_s, centred)
        )
    seal(folder, model.info)


def check_storable(estimator: Any) -> None:
    """Raise ``ModelError`` where a fitted estimator holds a type that a model file may not hold."""
    from skops import io

    _refuse_foreign(io.dumps(estimator))


def _refuse_foreign(content: bytes) -> None:
    if foreign := _foreign_types(content):
        raise ModelError(
            f"{foreign[0]} cannot be stored: a model file holds only types that can be checked when it is read, "
            "those of this package and most of scikit-learn's, trees not among them; crossval evaluates all"
        )


def seal(folder: Path, info: ModelInfo) -> None:
    """Write the manifest of the files that lie in a folder."""
    files = {name: _sha256((folder / name).read_bytes()) for name in FILES if (folder / name).is_file()}
    manifest = Manifest(version=VERSION, files=files, info=info)
    atomic_write(folder / MANIFEST_FILE, manifest.model_dump_json(indent=2) + "\n")


def read_model(folder: Path) -> TerrainModel:
    """Read a model folder.

    Raises
    ------
    ModelError
        if it is no model of this package, is damaged, or holds a type that is not on the list.
    """
    info, contents = read_files(folder)
    file = folder / MODEL_FILE
    recipe, novelty = _load(file, contents[MODEL_FILE])
    try:
        support = None if info.support is None else SupportTable.from_json(info.support, info.classes)
    except DataError as error:
        raise _damaged(folder / MANIFEST_FILE, error) from error
    try:
        _, network = _without_network(recipe)
        if network is not None:
            file = folder / ONNX_FILE
            network.numbers_ = numbers_of_onnx(contents[ONNX_FILE], network.columns)
            check_network(network.numbers_, len(info.classes))
            file = folder / MODEL_FILE
        if novelty is not None:
            check_novelty(novelty, len(info.classes))
        model = TerrainModel(recipe, info, novelty, support)
        _try(model)
    except ConfigError:
        raise
    except Exception as error:  # numbers of a stranger lead anything to anything
        raise ModelError(f"{file}: cannot be loaded ({_words(error)})") from error
    return model


def read_files(folder: Path) -> tuple[ModelInfo, dict[str, bytes]]:
    """Return what a model is and the content of its files, all of which agree with the manifest.

    Raises
    ------
    ModelError
        if there is no model, or a file is missing, damaged or a link out of the folder.
    """
    place = folder / MANIFEST_FILE
    if not place.is_file() or not (folder / MODEL_FILE).is_file():
        raise ModelError(f"{folder}: holds no model of this package ({MODEL_FILE} and {MANIFEST_FILE})")
    check_inside(place, folder, str(place), ModelError)
    content = read_regular(place, str(place), ModelError, MAX_JSON_BYTES)
    try:
        version = parse_json(content)["version"]
        if version != VERSION:
            raise ModelError(f"{place}: has version {shown(version)}; version {VERSION} is read here")
        manifest = parse_document(content, Manifest)
        info, listed = manifest.info, manifest.files
        for stream in info.layout.channels:
            info.layout.n_samples(stream, info.rule.length_s)
        if MODEL_FILE not in listed or not set(listed) <= set(FILES):
            raise DataError("its list of files is not that of a model")
    except (ConfigError, DataError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise _damaged(place, error) from error
    contents = {}
    for name, expected in listed.items():
        file = folder / name
        check_inside(file, folder, str(file), ModelError)
        contents[name] = read_regular(file, str(file), ModelError, MAX_MODEL_BYTES)
        if (found := _sha256(contents[name])) != expected:
            raise ModelError(
                f"{file}: is damaged (SHA-256 {found[:12]}..., {printable(expected[:12])}... expected)"
            )
    return info, contents


def drawn_window(layout: Layout, length_s: float) -> Windows:
    """Return a window of noise with the channels and rates of a layout, to try a model with."""
    rng = np.random.default_rng(0)
    values = {
        stream: rng.standard_normal((1, len(names), layout.n_samples(stream, length_s)))
        for stream, names in layout.channels.items()
    }
    return _windows(layout, length_s, values)


def _windows(layout: Layout, length_s: float, values: Mapping[str, Array]) -> Windows:
    n = len(next(iter(values.values())))
    unknown = np.full(n, "", dtype=object)
    return Windows(values, layout.channels, layout.rate_hz, length_s, np.zeros(n), unknown, unknown)


class WindowProbabilities:
    """What MLflow's ``pyfunc`` calls: a table of windows in, the probability of each terrain out."""

    def __init__(self, model: TerrainModel) -> None:
        self.model = model

    def predict(self, model_input: Any, params: Mapping[str, Any] | None = None) -> Any:
        """Return a table with a column a terrain.

        Parameters
        ----------
        model_input : table with a row a window and a column a channel, as ``imu.gyro_x_radps``; each cell
            holds the samples of that channel
        params : not used
        """
        import pandas as pd

        layout = self.model.layout
        values = {
            stream: np.stack(
                [np.stack([*model_input[f"{stream}.{name}"]]).astype(float) for name in names], axis=1
            )
            for stream, names in layout.channels.items()
        }
        found = self.model.recipe.predict_proba(_windows(layout, self.model.info.window_s, values))
        return pd.DataFrame(found, columns=list(self.model.info.classes))


def _load_pyfunc(path: str) -> WindowProbabilities:
    """Return what MLflow loads by ``mlflow.pyfunc.load_model``."""
    return WindowProbabilities(read_model(Path(path)))


def _without_network(recipe: WindowPipeline) -> tuple[WindowPipeline, Any]:
    """Return a recipe whose network, where it has one, lacks its numbers; and that network."""
    last = recipe[-1]
    network = last if hasattr(last, "numbers_") else getattr(last, "network_", None)
    if network is None:
        return recipe, None
    bare = copy.copy(network)
    bare.numbers_ = None
    if network is last:
        last = bare
    else:
        last = copy.copy(last)
        last.network_ = bare
    changed = copy.copy(recipe)
    changed.steps = [*recipe.steps[:-1], (recipe.steps[-1][0], last)]
    return changed, network


def _load(file: Path, content: bytes) -> tuple[WindowPipeline, NoveltyNumbers | None]:
    from skops import io

    from features.recipes import WindowPipeline

    try:
        with zipfile.ZipFile(streams.BytesIO(content)) as archive:
            unpacked_bytes = sum(entry.file_size for entry in archive.infolist())
        if unpacked_bytes > MAX_UNPACKED_BYTES:
            raise ModelError(f"{file}: unpacks to {unpacked_bytes} bytes, {MAX_UNPACKED_BYTES} are read")
        if foreign := _foreign_types(content):
            raise ModelError(f"{file}: holds {foreign[0]}, a type that models of this package do not hold")
        found = io.loads(content, trusted=list(TRUSTED_TYPES))
    except ModelError:
        raise
    except Exception as error:  # skops, numpy and scikit-learn raise whatever a damaged archive leads them to
        raise ModelError(f"{file}: cannot be loaded ({_words(error)})") from error
    recipe, novelty = (
        (found.get("recipe"), found.get("novelty")) if isinstance(found, dict) else (found, None)
    )
    if not isinstance(recipe, WindowPipeline):
        raise ModelError(f"{file}: holds a {type(recipe).__name__}, not a recipe of this package")
    if not hasattr(recipe[0], "layout_"):
        raise ModelError(f"{file}: holds a recipe that was never fitted")
    if novelty is not None and not isinstance(novelty, NoveltyNumbers):
        raise ModelError(f"{file}: holds a {type(novelty).__name__}, not a novelty score")
    return recipe, novelty


def _foreign_types(content: bytes) -> list[str]:
    """Return the types in a file that are not on the list, sorted."""
    from skops import io

    foreign = sorted(set(io.get_untrusted_types(data=content)) - set(TRUSTED_TYPES))
    return [printable(name[:MAX_NAME]) for name in foreign]


def _try(model: TerrainModel) -> None:
    """Refuse a model that cannot classify a window with the channels that it names."""
    info, recipe = model.info, model.recipe
    window = drawn_window(info.layout, info.window_s)
    if tuple(str(name) for name in recipe.classes_) != info.classes:
        raise DataError("its classes are not those of the manifest")
    probability = np.asarray(recipe.predict_proba(window))
    if probability.shape != (1, len(info.classes)):
        raise DataError(f"it gives probabilities of the shape {probability.shape}")
    if model.novelty is not None:
        n_features = recipe.matrix.of(window).shape[1]
        if model.novelty.settings[1] != n_features:
            raise DataError(
                f"its novelty score is of {model.novelty.settings[1]:.0f} features; it has {n_features}"
            )


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _damaged(place: Path, error: Exception) -> ModelError:
    return ModelError(f"{place}: is damaged ({_words(error)})")


def _words(error: Exception) -> str:
    return printable(" ".join(str(error).split())[:200])
