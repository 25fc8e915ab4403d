"""What goes into a session and comes out of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from pipelines.models.model_files import TerrainModel
from pipelines.streaming.classifying import WindowOutput
from terrain.control.slip_table import SlipTable
from terrain.records import Array, Command, SlipTarget


class Served(NamedTuple):
    """What all sessions use; it is replaced whole.

    Parameters
    ----------
    number : rises with each replacement
    model, model_name : that classifies, and its URI; without one the terrain is unknown
    table : of target slips
    """

    number: int
    model: TerrainModel | None
    model_name: str
    table: SlipTable


@dataclass(frozen=True, slots=True)
class SessionRequest:
    """What a robot says of itself before its first sample.

    Parameters
    ----------
    session : name of the session, one a robot
    robot : name of its description; a robot that has none is observed by its channels
    channels : of each stream that it sends, in the order of the columns
    control : whether commands are asked for
    follows : whether they drive the wheels; not where another controller does and these are only watched
    """

    session: str
    robot: str
    channels: Mapping[str, tuple[str, ...]]
    control: bool = False
    follows: bool = True


class CommandStatus(StrEnum):
    """What a command is made of: all of the chain, or why not."""

    OK = "ok"
    NO_SAMPLES = "no samples yet"
    NO_TWIST = "stopped: the desired motion is too old"
    NOT_FINITE = "stopped: a command was not finite"
    FAILED = "stopped: the step failed"


class Observation(NamedTuple):
    """What is known of the robot at a step; NaN and None where it is not.

    Parameters
    ----------
    terrain, probability : believed, and that of its last window; empty and NaN where unknown
    window : output of the last window
    target : target slip by drive state
    slip_ratio, slip_std, wheel_speed_mps, current_a : of each wheel
    speed_x_mps, speed_y_mps, yaw_rate_radps : of the robot
    sensors : health by name of the sensor, or of the stream where sensors are not judged one by one
    served : number of what was used
    """

    terrain: str
    probability: float
    window: WindowOutput | None
    target: Mapping[str, SlipTarget]
    slip_ratio: Array
    slip_std: Array
    wheel_speed_mps: Array
    current_a: Array
    speed_x_mps: float
    speed_y_mps: float
    yaw_rate_radps: float
    sensors: Mapping[str, str]
    served: int


class StepOutput(NamedTuple):
    """What comes out of a step.

    Parameters
    ----------
    time_s : on the robot's clock; NaN before its first sample
    number : of the step, from 1
    message : number of the last message that is in it; 0 before the first
    command, status : None where none was asked for
    observation : of the robot
    latency_s : from the arrival of the newest sample to the end of the step; NaN without one
    """

    time_s: float
    number: int
    message: int
    command: Command | None
    status: CommandStatus
    observation: Observation
    latency_s: float
