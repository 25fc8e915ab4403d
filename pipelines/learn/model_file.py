"""A trained model as a folder: ``model.skops``, ``network.onnx`` where it has one, and a manifest.

The scikit-learn part is loaded by skops with the fixed list of types below, so that a file cannot bring code of its
own; what a model needs of a user's modules stands in the manifest by name, and is imported where the user trusts them
(:mod:`pipelines.learn.trust`).  Trees of scikit-learn are stored as arrays (:mod:`pipelines.learn.stored_trees`).
The network is an ONNX graph, of operators that only compute.  The manifest,
written last, says how windows must be cut and holds the checksums of all files: a damaged folder is
distinguished from an intact one.  A registered model is a copy of such a folder.
"""

from __future__ import annotations

import hashlib
import io as streams
import subprocess
import sys
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict

from features.answers import answers_of
from features.extractor import is_centred
from features.windows import Layout, WindowRule
from pipelines.learn.stored_trees import trees_as_arrays, trees_of_arrays
from pipelines.learn.trust import check_trusted, import_own
from pipelines.live.model import ModelInfo, TerrainModel
from terrain import __version__
from terrain.classify.adaptation import Adaptation, check_adaptation
from terrain.classify.answers import Answers, check_answers
from terrain.classify.limits import Novelty, SupportTable, check_novelty, check_support
from terrain.classify.network import check_network, with_centred
from terrain.errors import ConfigError, DataError, ModelError
from terrain.files.atomic import atomic_write
from terrain.files.documents import MAX_JSON_BYTES, parse_document, parse_json
from terrain.files.names import MAX_NAME, MEBIBYTE, check_inside, printable, read_regular, shown
from terrain.records import Array, Windows

if TYPE_CHECKING:
    from features.recipes import WindowPipeline

MODEL_FILE, ONNX_FILE, MANIFEST_FILE = "model.skops", "network.onnx", "terrain_model.json"
CARD_FILE, TRAINING_FILE = "model_card.md", "training.json"
FILES = (MODEL_FILE, ONNX_FILE, CARD_FILE, TRAINING_FILE)
"""Files that a manifest may list; what else lies beside them is not read."""

VERSION = 7

FETCH_TIMEOUT_S = 120.0

MAX_MODEL_BYTES = 256 * MEBIBYTE  #: Of a file as it lies on disk; those of this package have some MiB

MAX_UNPACKED_BYTES = 1024 * MEBIBYTE
"""Of all that a model's archive unpacks to: megabytes of zeros pack to kilobytes."""

MAX_WINDOW_VALUES = 10_000_000  #: Of a stream in a window, with which a model is tried when it is read

_TRUSTED = {
    "builtins": "frozenset",
    "features.extractor": "Feature FeatureExtractor FunctionExtractor PlainExtractor SampleExtractor",
    "features.recipes": "WindowPipeline",
    "features.response": "ResponseExtractor",
    "features.windows": "Layout",
    "numpy": "dtype",
    "sklearn.calibration": "_CalibratedClassifier _SigmoidCalibration _TemperatureScaling",
    "sklearn.gaussian_process._gpc": "_BinaryGaussianProcessClassifierLaplace",
    "sklearn.gaussian_process.kernels": "ConstantKernel Matern Product RBF Sum WhiteKernel",
    "sklearn.multiclass": "_ConstantPredictor",
    "sklearn.neural_network._stochastic_optimizers": "AdamOptimizer SGDOptimizer",
    "sklearn.utils._bunch": "Bunch",
    "terrain.classify.adaptation": "Adaptation Shift",
    "terrain.classify.answers": "Answers",
    "terrain.classify.grouped": "OwnClassifier Preparation",
    "terrain.classify.limits": "Novelty SupportTable",
    "terrain.classify.network": "Augmentation GroupedNetwork NetworkChoice SampleColumns Trial",
    "terrain.classify.response": "GroundResponse GroupedResponse Process ResponseChoice ResponseColumns",
    "terrain.classify.stack": "GroupedStack StackChoice",
    "terrain.classify.svm": "Candidate GroupedSVC",
    "terrain.classify.trees": "Forest GroupedTrees",
}
_LIMITS = {"novelty": Novelty, "support": SupportTable, "adaptation": Adaptation, "answers": Answers}

TRUSTED_TYPES = tuple(f"{module}.{name}" for module, names in _TRUSTED.items() for name in names.split())
"""Types beyond those that skops trusts itself which a model of this package may hold."""

Own = tuple[str, ...]
"""``MODULE.NAME`` of what a model needs of a user's modules."""


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
        least_rate_hz={},
        run_accuracy={},
        package_version=__version__,
        class_ratio=dict(zip(classes.tolist(), (counts / counts.sum()).tolist(), strict=True)),
        **known,
    )


class Manifest(BaseModel):
    """What ``terrain_model.json`` holds: its version, the SHA-256 of each file, and what the model is."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    version: int
    files: dict[str, str]
    info: ModelInfo


def write_model(folder: Path, model: TerrainModel) -> Own:
    """Write a model's files into a folder in place of those that lie there, the manifest last; return its own code.

    Raises
    ------
    ModelError
        as :func:`packed`.
    ConfigError
        if it has a network and onnx is not installed.
    """
    network = _network(model.recipe)
    graph = b"" if network is None else network.onnx_
    try:
        if network is not None:
            network.onnx_ = b""  # it lies in a file of its own
        content, own = packed({"recipe": model.recipe, **{name: getattr(model, name) for name in _LIMITS}})
    finally:
        if network is not None:
            network.onnx_ = graph
    for name in (MANIFEST_FILE, *FILES):  # of a model that lay there
        (folder / name).unlink(missing_ok=True)
    atomic_write(folder / MODEL_FILE, content)
    if network is not None:
        levels = model.recipe[0].level_sets
        centred = {
            each.stream: [is_centred(each.stream, name, levels) for name in each.channels]
            for each in network.columns
        }
        atomic_write(folder / ONNX_FILE, with_centred(graph, centred, model.info.window_s))
    seal(folder, replace(model.info, own_code=own))
    return own


@cache
def skops_io() -> ModuleType:
    """Return ``skops.io``, without torch and dask, which its walk through scikit-learn imports: two seconds."""
    unneeded = [f"sklearn.externals.array_api_compat.{name}" for name in ("torch", "dask")]
    unneeded = [name for name in unneeded if name not in sys.modules]
    sys.modules |= dict.fromkeys(unneeded)  # type: ignore[arg-type]
    try:
        return import_module("skops.io")
    finally:
        for name in unneeded:
            del sys.modules[name]


def packed(fitted: Any) -> tuple[bytes, Own]:
    """Return what a model file holds of fitted parts, and what it needs of a user's modules.

    Raises
    ------
    ModelError
        if one is of a type that could not be read back.
    """
    try:
        with trees_as_arrays(fitted):
            content: bytes = skops_io().dumps(fitted)
        own = _foreign_types(content)
        import_own(own)
        trees_of_arrays(skops_io().loads(content, trusted=[*TRUSTED_TYPES, *own]))
    except Exception as error:  # skops, and what a user's objects raise when they are written and read back
        raise ModelError(
            f"the recipe cannot be stored ({_words(error)}): a model file holds types of this package and of "
            "scikit-learn, and functions and classes at the top of a module of yours; crossval evaluates all"
        ) from error
    return content, own


def seal(folder: Path, info: ModelInfo) -> None:
    """Write the manifest of the files that lie in a folder."""
    contents = {name: (folder / name).read_bytes() for name in FILES if (folder / name).is_file()}
    files = {name: hashlib.sha256(content).hexdigest() for name, content in contents.items()}
    manifest = Manifest(version=VERSION, files=files, info=info)
    atomic_write(folder / MANIFEST_FILE, manifest.model_dump_json(indent=2) + "\n")


def read_model(source: str | Path, trust: Iterable[str] = ()) -> TerrainModel:
    """Read a model: a folder, or a registered one (``models:/NAME@champion``, ``models:/NAME/3``, ``runs:/...``).

    Parameters
    ----------
    source : folder or name
    trust : modules of one's own that it may import, beside those that were trusted before

    Raises
    ------
    ModelError
        if there is no such model, it is none of this package, is damaged, holds a type that is not on the
        list, or needs a module that is not trusted.
    """
    with model_folder(source) as folder:
        info, contents = read_files(folder)
    file = folder / MODEL_FILE
    try:
        recipe, limits = _unpacked(contents[MODEL_FILE], info.own_code, trust)
        novelty, support, adaptation, answers = (limits[name] for name in _LIMITS)
        if (network := _network(recipe)) is not None:
            file = folder / ONNX_FILE
            network.onnx_ = with_centred(contents[ONNX_FILE], {}, info.window_s)
            check_network(network.onnx_, network.columns, len(info.classes))
            file = folder / MODEL_FILE
        if tuple(str(name) for name in recipe.classes_) != info.classes:
            raise DataError("its classes are not those of the manifest")
        window = drawn_window(info)
        probability = np.asarray(recipe.predict_proba(window))
        if probability.shape != (1, len(info.classes)):
            raise DataError(f"it gives probabilities of the shape {probability.shape}")
        if not np.isfinite(probability).all():
            raise DataError("it gives probabilities that are not finite")
        if support is not None:
            check_support(support, info.classes)
        if adaptation is not None:
            check_adaptation(adaptation, info.classes)
            if not set(adaptation.levels) | set(adaptation.wheels) <= {
                (stream, name) for stream, names in info.channels.items() for name in names
            }:
                raise DataError("it adapts by channels that its windows do not have")
        if novelty is not None:
            check_novelty(novelty, len(info.classes))
            n_features = recipe[0].features_of(window).shape[1]
            if novelty.n_features != n_features:
                raise DataError(f"its novelty score is of {novelty.n_features} features; it has {n_features}")
        if answers is not None:
            check_answers(answers, info.classes, answers_of(window))
    except ConfigError:
        raise
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from error
    except Exception as error:  # skops, numpy and scikit-learn raise whatever a stranger's file leads them to
        raise ModelError(f"{file}: cannot be loaded ({_words(error)})") from error
    return TerrainModel(recipe, info, **limits)


@contextmanager
def model_folder(source: str | Path) -> Iterator[Path]:
    """Give the folder of a model; a copy, while the block lasts, of one that is registered.

    The tracking library takes longer to import than all of a live service, and a hundred megabytes: unless it
    is there already, the copy is made by a process of its own.

    Raises
    ------
    ModelError
        if there is no such folder or registered model.
    """
    uri = str(source)
    try:
        there = Path(uri).exists()
    except OSError as error:
        raise ModelError(f"{uri[:100]}: cannot be opened ({error.strerror})") from None
    if there:
        yield Path(uri)
        return
    if not uri.startswith(("models:/", "runs:/")):
        raise ModelError(f"{uri}: is neither a folder nor a model URI such as models:/NAME@champion")
    with TemporaryDirectory() as folder:
        if "mlflow" in sys.modules:
            from pipelines.data.tracking import fetch_model

            yield fetch_model(uri, folder)
            return
        command = [sys.executable, "-m", "pipelines.data.tracking", uri, folder]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=FETCH_TIMEOUT_S, check=False
            )
        except subprocess.TimeoutExpired:
            raise ModelError(f"{uri}: was not loaded within {FETCH_TIMEOUT_S:g} s") from None
        if done.returncode != 0:
            lines = done.stderr.strip().splitlines()
            raise ModelError(lines[-1] if lines else f"{uri}: cannot be loaded")
        yield Path(done.stdout.strip().splitlines()[-1])


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
        for stream, names in info.layout.channels.items():
            if len(names) * info.layout.n_samples(stream, info.rule.length_s) > MAX_WINDOW_VALUES:
                raise DataError(f"a window of it has more than {MAX_WINDOW_VALUES} values of {shown(stream)}")
        if MODEL_FILE not in listed or not set(listed) <= set(FILES):
            raise DataError("its list of files is not that of a model")
    except (ConfigError, DataError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ModelError(f"{place}: is damaged ({_words(error)})") from error
    contents = {}
    for name, expected in listed.items():
        file = folder / name
        check_inside(file, folder, str(file), ModelError)
        contents[name] = read_regular(file, str(file), ModelError, MAX_MODEL_BYTES)
        if (found := hashlib.sha256(contents[name]).hexdigest()) != expected:
            raise ModelError(
                f"{file}: is damaged (SHA-256 {found[:12]}..., {printable(expected[:12])}... expected)"
            )
    return info, contents


def drawn_window(info: ModelInfo) -> Windows:
    """Return a window of noise with the channels and rates of a model, to try it with."""
    rng = np.random.default_rng(0)
    sizes = {
        name: (1, len(of), info.layout.n_samples(name, info.window_s)) for name, of in info.channels.items()
    }
    return _windows(info, {stream: rng.standard_normal(size) for stream, size in sizes.items()})


def _windows(info: ModelInfo, values: Mapping[str, Array]) -> Windows:
    n = len(next(iter(values.values())))
    unknown = np.full(n, "", dtype=object)
    return Windows(values, info.channels, info.rate_hz, info.window_s, np.zeros(n), unknown, unknown)


def _load_pyfunc(path: str) -> Any:
    """Return what MLflow loads by ``mlflow.pyfunc.load_model``: a table of windows in, probabilities out."""
    import pandas as pd

    model = read_model(Path(path))
    recipe, info = model.recipe, model.info

    def predict(model_input: Any, params: Mapping[str, Any] | None = None) -> Any:
        """Return a table with a column a terrain.

        Parameters
        ----------
        model_input : table with a row a window and a column a channel, as ``imu.gyro_x_radps``; each cell
            holds the samples of that channel
        params : not used
        """
        values = {
            stream: np.stack(
                [np.stack([*model_input[f"{stream}.{name}"]]).astype(float) for name in names], axis=1
            )
            for stream, names in info.channels.items()
        }
        return pd.DataFrame(recipe.predict_proba(_windows(info, values)), columns=list(info.classes))

    return SimpleNamespace(predict=predict)


def _network(recipe: WindowPipeline) -> Any:
    """Return the fitted network of a recipe; None where it has none."""
    last = recipe[-1]
    return last if hasattr(last, "onnx_") else getattr(last, "network_", None)


def _unpacked(content: bytes, own: Own, trust: Iterable[str]) -> tuple[WindowPipeline, dict[str, Any]]:
    """Return the recipe of a model file and its limits by name; ``DataError`` says why it is none."""
    from features.recipes import WindowPipeline

    with zipfile.ZipFile(streams.BytesIO(content)) as archive:
        unpacked_bytes = sum(entry.file_size for entry in archive.infolist())
    if unpacked_bytes > MAX_UNPACKED_BYTES:
        raise DataError(f"it unpacks to {unpacked_bytes} bytes, {MAX_UNPACKED_BYTES} are read")
    if foreign := set(_foreign_types(content)) - set(own):
        name = printable(min(foreign)[:MAX_NAME])
        raise DataError(f"it holds {name}, a type that models of this package do not hold")
    check_trusted(own, trust)
    import_own(own)
    found = skops_io().loads(content, trusted=[*TRUSTED_TYPES, *own])
    trees_of_arrays(found)
    parts = found if isinstance(found, dict) else {"recipe": found}
    recipe, limits = parts.get("recipe"), {name: parts.get(name) for name in _LIMITS}
    if not isinstance(recipe, WindowPipeline):
        raise DataError(f"it holds a {type(recipe).__name__}, not a recipe of this package")
    if not hasattr(recipe[0], "layout_"):
        raise DataError("it holds a recipe that was never fitted")
    for name, kind in _LIMITS.items():
        if (limit := limits[name]) is not None and not isinstance(limit, kind):
            raise DataError(f"it holds a {type(limit).__name__}, {kind.__name__} is read")
    return recipe, limits


def _foreign_types(content: bytes) -> Own:
    """Return the types and functions in a file that are not on the list, as ``MODULE.NAME``."""
    return tuple(sorted(set(skops_io().get_untrusted_types(data=content)) - set(TRUSTED_TYPES)))


def _words(error: Exception) -> str:
    return printable((" ".join(str(error).split()) or type(error).__name__)[:200])
