"""A fitted recipe as plain arrays, for a service: nothing of scikit-learn is imported or unpickled."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from features.matrix import FeatureMatrix
from features.samples import columns_of, window_samples
from features.windows import Layout
from pipelines.models.results import ModelInfo
from terrain.classify.network_numbers import BranchNumbers, NetworkNumbers
from terrain.classify.stack_numbers import StackNumbers, check_stack, probabilities, stack_of
from terrain.classify.svm_numbers import SvmNumbers
from terrain.errors import DataError
from terrain.records import Array, Windows

if TYPE_CHECKING:
    from pipelines.learn.recipes import WindowPipeline

NUMBERS_FILE = "numbers.npz"
MAX_UNPACKED_BYTES = 1 << 30


class LeanRecipe:
    """From windows to probabilities, by the numbers of a fitted recipe.

    Parameters
    ----------
    matrix : what features and samples are computed from
    numbers : of the classifier
    classes : in the order of the probabilities
    """

    def __init__(self, matrix: FeatureMatrix, numbers: StackNumbers, classes: tuple[str, ...]) -> None:
        self.matrix, self.numbers = matrix, numbers
        self.classes_ = np.array(classes)

    def predict_proba(self, windows: Windows) -> Array:
        """Return calibrated probabilities (n_windows, k)."""
        return self.probabilities(windows)

    def probabilities(self, windows: Windows, features: Array | None = None) -> Array:
        """Return calibrated probabilities (n_windows, k), from features where they are there already."""
        if features is None and self.numbers.svm is not None:
            features = self.matrix.of(windows)
        return probabilities(
            self.numbers,
            features,
            None if self.numbers.network is None else window_samples(self.matrix, windows),
        )


def write_numbers(folder: Path, recipe: WindowPipeline) -> None:
    """Write the numbers of a fitted recipe beside its model."""
    matrix: FeatureMatrix = recipe[0].matrix
    streams = list(matrix.layout.channels)
    arrays = {
        **_arrays_of(stack_of(recipe[-1].numbers())),
        "streams": np.array(streams),
        "n_samples": np.array([matrix.n_samples[stream] for stream in streams]),
        "rate_hz": np.array([matrix.layout.rate_hz[stream] for stream in streams]),
        "channels": np.array([",".join(matrix.layout.channels[stream]) for stream in streams]),
        "level_sets": np.array(matrix.level_sets, dtype=np.str_),
        "length_s": np.array(matrix.length_s),
    }
    with (folder / NUMBERS_FILE).open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def _arrays_of(numbers: StackNumbers) -> dict[str, Array]:
    """Return the arrays of a classifier by name; those of an SVM alone as releases before have them."""
    arrays: dict[str, Array] = {} if numbers.svm is None else dict(numbers.svm._asdict())
    network = numbers.network
    if network is not None:
        arrays["joint_weights"] = numbers.weights
        for name in ("fill", "head_weight", "head_bias"):
            arrays[f"network_{name}"] = getattr(network, name)
        arrays["network_temperature"] = np.array(network.temperature)
        for i, branch in enumerate(network.branches):
            arrays |= {f"network_{i}_{name}": array for name, array in branch._asdict().items()}
    return arrays


def _numbers_of(found: Mapping[str, Array], matrix: FeatureMatrix) -> StackNumbers:
    svm = SvmNumbers(*(found[name] for name in SvmNumbers._fields)) if "vectors" in found else None
    if "joint_weights" not in found:
        if svm is None or any(name.startswith("network_") for name in found):
            raise DataError("it holds no whole classifier")
        return stack_of(svm)
    columns = columns_of(matrix)
    branches = tuple(
        BranchNumbers(*(found[f"network_{i}_{name}"] for name in BranchNumbers._fields))
        for i in range(len(columns))
    )
    network = NetworkNumbers(
        columns,
        found["network_fill"],
        branches,
        found["network_head_weight"],
        found["network_head_bias"],
        float(found["network_temperature"]),
    )
    return StackNumbers(found["joint_weights"], svm, network)


def read_numbers(content: bytes, info: ModelInfo) -> LeanRecipe:
    """Return the recipe that a file's content holds.

    Raises
    ------
    DataError
        if the numbers do not fit each other or the model.
    ValueError, KeyError
        if it is no such file.
    """
    try:
        members = zipfile.ZipFile(io.BytesIO(content)).infolist()
        if sum(member.file_size for member in members) > MAX_UNPACKED_BYTES:
            raise DataError("it unpacks to more than a GiB")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
    except DataError:
        raise
    except Exception as error:  # whatever a damaged archive leads to
        raise DataError(str(error) or type(error).__name__) from error
    streams = [str(name) for name in found["streams"]]
    channels = {
        stream: tuple(str(names).split(",")) for stream, names in zip(streams, found["channels"], strict=True)
    }
    layout = Layout(
        channels, {stream: float(rate) for stream, rate in zip(streams, found["rate_hz"], strict=True)}
    )
    for stream, names in channels.items():
        if not set(names) <= set(info.channels.get(stream, ())):
            raise DataError(f"its channels of {stream!r} are not those of the model")
    n_samples = {stream: int(n) for stream, n in zip(streams, found["n_samples"], strict=True)}
    level_sets = tuple(str(name) for name in found["level_sets"])
    matrix = FeatureMatrix(layout, float(found["length_s"]), n_samples, level_sets)
    numbers = _numbers_of(found, matrix)
    check_stack(numbers, len(info.classes))
    return LeanRecipe(matrix, numbers, info.classes)
