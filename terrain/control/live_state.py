"""What outlives a restart: the biases of the sensors, and the terrain, each only while it is fresh.

All else of a live chain (pose, speeds, samples of a window that is not whole) is measured anew in seconds.
A bias walks: the variance that it was saved with grows by that of its walk for the time that has passed.  The
terrain is that under the robot when it was saved, and the robot may have been moved since.
"""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter
from pydantic.dataclasses import dataclass

from terrain.control.switching import UNKNOWN
from terrain.errors import DataError
from terrain.files.documents import accepted
from terrain.files.names import read_regular
from terrain.logs.run_folders import Number

#: A bias older than that is estimated anew: with temperature it moves further than its walk says.
BIASES_FRESH_S = 600.0
#: As long as a terrain is believed without a window that confirms it (``SwitchSettings``).
BELIEF_FRESH_S = 10.0
CLOCK_SLACK_S = 1.0  #: A state may seem so far from the future: clocks are adjusted.
LARGEST_FILE = 65536


class Bias(NamedTuple):
    """A sensor's bias and its standard deviation, in the unit of its name."""

    mean: FiniteFloat
    std: Annotated[FiniteFloat, Field(gt=0.0)]


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class LiveState:
    """What a live chain knew at a time."""

    robot: str
    filter: str  #: whose biases these are
    saved_s: Number  #: since 1970
    biases: dict[str, Bias]  #: by name of the state
    terrain: str = UNKNOWN  #: believed; empty where it was unknown
    probability: Number = math.nan
    target_ratio: Number = math.nan  #: target slip that was aimed for; NaN where there was none

    def usable(self, robot: str, filter_name: str, now_s: float) -> LiveState:
        """Return it without what may not be used now: what is too old, or another robot's or filter's.

        Examples
        --------
        >>> state = LiveState("agrimaro", "vio15", 1000.0, {"gyro": Bias(0.01, 0.001)}, "grass", 0.9, 0.1)
        >>> later = state.usable("agrimaro", "vio15", 1060.0)
        >>> state.usable("agrimaro", "vio15", 1005.0).terrain, later.terrain, later.biases["gyro"].mean
        ('grass', '', 0.01)
        """
        age_s = now_s - self.saved_s
        suits = self.robot == robot and age_s >= -CLOCK_SLACK_S  # False for NaN
        fresh_biases = suits and self.filter == filter_name and age_s <= BIASES_FRESH_S
        fresh_belief = suits and age_s <= BELIEF_FRESH_S and self.terrain != UNKNOWN
        belief = (self.terrain, self.probability, self.target_ratio) if fresh_belief else ()
        return LiveState(self.robot, self.filter, self.saved_s, self.biases if fresh_biases else {}, *belief)


class _Document(BaseModel):
    """A file: a state and its checksum."""

    model_config = ConfigDict(extra="forbid")

    version: Literal[1] = 1
    sha256: str
    state: LiveState


def _sha256(state: LiveState) -> str:
    return hashlib.sha256(TypeAdapter(LiveState).dump_json(state)).hexdigest()


def to_text(state: LiveState) -> str:
    """Return a state as JSON, with a checksum of its content."""
    return _Document(sha256=_sha256(state), state=state).model_dump_json(indent=1) + "\n"


def from_text(text: str | bytes, place: str = "saved state") -> LiveState:
    """Return the state that a text holds; messages begin with its place.

    ``DataError`` where it is damaged, of another version, or its checksum is another.

    Examples
    --------
    >>> from_text("{}")
    Traceback (most recent call last):
    terrain.errors.DataError: saved state: is damaged (key 'sha256' is missing)
    """
    document = accepted(_Document, text, place, DataError, "is damaged")
    if _sha256(document.state) != document.sha256:
        raise DataError(f"{place}: is damaged (its checksum is another)")
    return document.state


def load_state(path: Path) -> LiveState | None:
    """Return the state of a file; None where there is none, ``DataError`` for one that cannot be read."""
    if not path.exists():
        return None
    return from_text(read_regular(path, str(path), DataError, LARGEST_FILE), str(path))
