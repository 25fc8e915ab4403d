"""Hyper-parameters of the SVM, and the file of ``--params`` that holds them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field

from terrain.errors import ConfigError
from terrain.files.documents import MAX_JSON_BYTES, parse_document
from terrain.files.names import printable
from terrain.files.regular import read_regular


class SvmParams(NamedTuple):
    """Hyper-parameters of the SVM, as :class:`terrain.classify.svm.Candidate`."""

    C: Annotated[float, Field(gt=0.0, le=1e6)]
    gamma: Annotated[float, Field(gt=0.0, le=1e3)]
    percentile: Annotated[float, Field(gt=0.0, le=100.0)]


class _ParamsFile(BaseModel):
    model_config = ConfigDict(extra="ignore")

    version: Literal[1]
    params: SvmParams


def read_params(file: Path) -> SvmParams:
    """Return the hyper-parameters of a file that a search wrote.

    Raises
    ------
    ConfigError
        if it is no such file, of another version, or has an unknown or impossible hyper-parameter.
    """
    content = read_regular(file, str(file), ConfigError, MAX_JSON_BYTES)
    try:
        return parse_document(content, _ParamsFile).params
    except ValueError as error:
        raise ConfigError(f"{file}: is no result of a search ({printable(str(error))[:200]})") from None
