"""A fitted recipe as plain arrays, for a service: nothing of scikit-learn is imported or unpickled."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from features.matrix import FeatureMatrix
from features.windows import Layout
from pipelines.models.results import ModelInfo
from terrain.classify.svm_numbers import SvmNumbers, check_numbers, probabilities
from terrain.errors import DataError
from terrain.records import Array, Windows

if TYPE_CHECKING:
    from pipelines.models.recipes import WindowPipeline

NUMBERS_FILE = "numbers.npz"
MAX_UNPACKED_BYTES = 1 << 30


class LeanRecipe:
    """From windows to probabilities, by the numbers of a fitted recipe.

    Parameters
    ----------
    matrix : what the features are computed from
    numbers : of the classifier
    classes : in the order of the probabilities
    """

    def __init__(self, matrix: FeatureMatrix, numbers: SvmNumbers, classes: tuple[str, ...]) -> None:
        self.matrix, self.numbers = matrix, numbers
        self.classes_ = np.array(classes)

    def predict_proba(self, windows: Windows) -> Array:
        """Return calibrated probabilities (n_windows, k)."""
        return probabilities(self.numbers, self.matrix.of(windows))


def write_numbers(folder: Path, recipe: WindowPipeline) -> None:
    """Write the numbers of a fitted recipe beside its model."""
    matrix: FeatureMatrix = recipe[0].matrix
    numbers: SvmNumbers = recipe[-1].numbers()
    streams = list(matrix.layout.channels)
    arrays = {
        **numbers._asdict(),
        "streams": np.array(streams),
        "n_samples": np.array([matrix.n_samples[stream] for stream in streams]),
        "rate_hz": np.array([matrix.layout.rate_hz[stream] for stream in streams]),
        "channels": np.array([",".join(matrix.layout.channels[stream]) for stream in streams]),
        "level_sets": np.array(matrix.level_sets, dtype=np.str_),
        "length_s": np.array(matrix.length_s),
    }
    with (folder / NUMBERS_FILE).open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


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
    numbers = SvmNumbers(*(found[name] for name in SvmNumbers._fields))
    check_numbers(numbers, len(info.classes))
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
    return LeanRecipe(
        FeatureMatrix(layout, float(found["length_s"]), n_samples, level_sets), numbers, info.classes
    )
