"""Exceptions: every one is the user's to mend, and its message says how.

The command line prints the message of a :class:`TerrainError` as one sentence and exits with code 2;
anything else that is raised is a fault of this package and keeps its traceback.
"""

from importlib import import_module
from typing import Any


class TerrainError(Exception):
    """Base of every error that input, options or files can cause."""


class OutsideRegionWarning(UserWarning):
    """A drive leaves the region that a robot's effects were validated in: it is extrapolated."""


class NotTakenWarning(UserWarning):
    """Filters do not take part of what was learned of a robot, which its simulation does."""


class DoubtfulRunWarning(UserWarning):
    """A run that was read may not be what it states: its units, signs, axes, or the robot that is named."""


class LogError(TerrainError):
    """A run log cannot be read as it stands: the message names file, row and value."""


class ConfigError(TerrainError):
    """An option, a mapping or a YAML file holds something that is not accepted."""


class DataError(TerrainError):
    """The data are readable but cannot answer the question asked (one class only, too few runs...)."""


class ModelError(TerrainError):
    """A model file is damaged, foreign, or does not fit the data it is given."""


def one_line(error: BaseException, most: int = 160) -> str:
    r"""Return what an error of a library states in one line, cut off; its type where it states nothing.

    Examples
    --------
    >>> one_line(ValueError("no\n  end")), one_line(EOFError())
    ('no end', 'EOFError')
    """
    return " ".join(str(error).split())[:most] or type(error).__name__


def library(name: str, need: str, extra: str) -> Any:
    """Return a module of a package that not everybody needs.

    Parameters
    ----------
    name : of the module
    need : what needs which package, as the refusal begins
    extra : of this package that installs it

    Raises
    ------
    ConfigError
        if the package is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(f"{need}: pip install 'terrain-slip[{extra}]'") from error
