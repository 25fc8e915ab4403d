"""Types of the catalogue: an effect, its parameters, their homes in a description and inverses on samples."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING = (
    "yaw_rate_radps",
    "speed_x_mps",
    "speed_y_mps",
    "accel_x_mps2",
    "current_a",
    "turning_current_a",
    "heading_rate_radps",
)
CHANNELS: tuple[str, ...] = (GYRO, SPEED_X, SPEED_Y, ACCEL, CURRENT, TURNING_CURRENT, HEADING)
"""Channels that are compared: gyro, speed over ground of the camera's point, accelerometer, sum of the motor
currents, right minus left current, and the rate of a heading that no gyro measured (lidar, two antennas)."""

MOTION: tuple[str, ...] = (GYRO, SPEED_X, SPEED_Y)
"""Channels of the planar motion."""

SKID, TRACKED, SWERVE, OMNI, BICYCLE = "skid_steer", "tracked", "swerve", "omni", "bicycle"
SKIDDING = (SKID, TRACKED)
"""Drives that turn by a difference of their sides."""

BOTH = (*SKIDDING, SWERVE)
"""Drives of wheels that do not roll across, but for cars."""

WITH_IMU = (*BOTH, BICYCLE)
"""Drives whose logs have an IMU."""

EVERY = (*WITH_IMU, OMNI)


class Combine(Enum):
    """How a parameter ``e`` changes a number ``x`` of a robot's description."""

    ADDED = "x + e"
    SUBTRACTED = "x - e"
    TIMES = "x (1 + e)"
    OVER = "x / (1 + e)"

    def apply(self, number: float, value: float) -> float:
        """Return the changed number.

        Examples
        --------
        >>> Combine.OVER.apply(0.3, 1.0), Combine.SUBTRACTED.apply(0.0, 0.1)
        (0.15, -0.1)
        """
        if self is Combine.ADDED:
            return number + value
        if self is Combine.SUBTRACTED:
            return number - value
        return number * (1.0 + value) if self is Combine.TIMES else number / (1.0 + value)


class Home(NamedTuple):
    """A number of the description that a parameter changes.

    Parameters
    ----------
    section : of the description; empty for a number of the robot itself
    field : in the section
    combine : how the two are combined
    scaled_by : field of the same section that the parameter is multiplied by first; empty for none
    optional : whether the parameter also has its other homes where the description lacks this section
    """

    section: str
    field: str
    combine: Combine
    scaled_by: str = ""
    optional: bool = False


class Inverse(NamedTuple):
    """How a parameter is taken off the samples of a log, by :class:`terrain.extension.Correction`.

    Parameters
    ----------
    streams : whose samples or stamps change
    formula : corrected from measured, in the signals of :mod:`terrain.effects.catalogue`
    without_home : samples change only where the description lacks the section of the parameter's home
    """

    streams: tuple[str, ...]
    formula: str
    without_home: bool = False


class Parameter(NamedTuple):
    """A number of the simulation that is 0 where its effect is absent.

    Parameters
    ----------
    name : ends in its unit
    low, high : bounds of the search
    step : a small change that is still visible, over which sensitivities are taken
    homes : where the description has it; all of them change together
    inverse : how it is taken off samples, if it can be
    one_sided : sensitivities are taken towards the positive side only: a backlash is not negative.  All
        others are taken to both sides: a delay to one side alone is half a step off, and noise of the wheels
        looks like it
    scatter_rank : place in the order in which values that scatter from run to run are drawn, from 1; 0 for a
        parameter that does not scatter
    as_percent : pages write it as a percentage
    is_error : it states the error of something that is there, so that pages write "off by"
    deprecated : former names, accepted in files and on the command line
    """

    name: str
    low: float
    high: float
    step: float
    homes: tuple[Home, ...] = ()
    inverse: Inverse | None = None
    one_sided: bool = False
    scatter_rank: int = 0
    as_percent: bool = False
    is_error: bool = False
    deprecated: tuple[str, ...] = ()

    @property
    def unit(self) -> str:
        """Last word of the name."""
        return self.name.rpartition("_")[2]

    @property
    def label(self) -> str:
        """Words of the name without its unit, as pages write it."""
        return self.name.rpartition("_")[0].replace("_", " ")


class PlantPart(Enum):
    """Which part of the dynamic simulation an effect acts in."""

    DESCRIPTION = "the number of its home"
    BODY = "masses and wheel radii of the plant"
    LINKAGE = "between the steering encoders and the wheels"
    CONTACT = "between wheel and ground"
    SENSORS = "samples and stamps"


class Wording(Enum):
    """What a sentence makes of the values of an effect."""

    NUMBER = "the number of its home, or the values themselves"
    TRACK = "an effective track in m"
    MEASURED_POINT = "where the measured point is"
    LATE = "who is late, in s"
    CAMERA_YAW = "an angle of the camera in degrees"
    FAST_TURNS = "by how much the track acts narrower in a fast turn"
    LOSS_IN_TURNS = "the speed that a turn takes"
    SIDE_SLIP = "the speed to the outside of a turn"
    GYRO_SCALE = "by how much the gyro reads too much"
    CENTRE_OF_MASS = "where the centre of mass is"
    WHEEL_DISTANCE = "a distance of the wheels in m"
    SIDES = "by how much the wheels of a side are larger"
    UNDERSTEER = "by how much less it turns at a speed"


class Effect(NamedTuple):
    """An error that the simulation may have.

    Parameters
    ----------
    name : as ``--effect`` and results have it
    parameters : its numbers
    formula : in the signals of :mod:`terrain.effects.catalogue`
    source : of the formula
    drives : kinds of robots that it applies to
    channels : of :data:`CHANNELS`, where it is visible: a tenth as clearly over the noise as in the clearest
    needs : the driving that excites it
    sensed_only : it changes what sensors measure, and not the motion of the body
    plant : the part of the dynamic simulation that it acts in; None where that simulates none of its robots
    aliases : other names of the same effect, which no log distinguishes from it
    twins : names of effects that look the same, and the channel that a log needs to distinguish them
    deprecated : former names, accepted on the command line
    wording : what sentences make of its values
    late : who is late by a positive and by a negative value, of an effect that is worded so
    modifies : name of the effect without which it does nothing; empty for an effect that acts by itself
    beside : drive, and name of the effect that has to be known before runs of it can show this one
    """

    name: str
    parameters: tuple[Parameter, ...]
    formula: str
    source: str
    drives: tuple[str, ...]
    channels: tuple[str, ...]
    needs: str
    sensed_only: bool = False
    plant: PlantPart | None = None
    aliases: tuple[str, ...] = ()
    twins: tuple[tuple[str, str], ...] = ()
    deprecated: tuple[str, ...] = ()
    wording: Wording = Wording.NUMBER
    late: tuple[str, str] = ("", "")
    modifies: str = ""
    beside: tuple[tuple[str, str], ...] = ()
