"""The chain of a robot that is driven, from samples to wheel commands.

::

    sample -> clocks -> motion -> terrain -> commands (terrain.control.robot_control)

Neither a tracking library nor a web server is imported; the simulator and the service on the robot call the
same object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from pipelines.live.chain import Chain, CommandStatus, Step
from pipelines.live.classifying import Classifier
from pipelines.live.model import TerrainModel
from terrain.control.live_state import LiveState
from terrain.control.robot_control import (
    DEFAULT_SETTINGS,
    OPEN_LOOP,
    PERIOD_S,
    PilotSettings,
    RobotControl,
    check_pilot,
)
from terrain.control.slip_table import SlipTable, load_slip_table
from terrain.control.switching import SWITCHING, OutputStatus, TerrainSource
from terrain.control.traction import TractionStatus
from terrain.estimation.clocks import Clocks, check_channels, finite_twist
from terrain.estimation.feed import places_among
from terrain.estimation.health import Health
from terrain.estimation.live import CHANNELS, Live, LiveEstimate, live_estimator
from terrain.estimation.models.choice import suitable_filter
from terrain.extension import correct_live
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Command, Sample
from terrain.robots import Robot


def pilot_classifier(
    model: TerrainModel | None,
    robot: Robot,
    thread: ThreadPoolExecutor | None = None,
    channels: Mapping[str, Sequence[str]] | None = None,
) -> Classifier:
    """Return the source of the terrain for a pilot: a model on what is measured and what the pilot's filter estimates.

    ``DataError`` where the model does not suit them; None is a model that comes later.  ``channels`` are as of
    :class:`LivePilot`.
    """
    if robot.drive == "swerve":
        return Classifier(model, robot, thread)
    channels = sensor_channels(robot) if channels is None else channels
    return Classifier(model, robot, thread, channels, suitable_filter(robot, channels))


class LivePilot(Chain):
    """Drive a robot along its desired twists.

    Parameters
    ----------
    robot : of any drive; a swerve robot with all sections
    table : target slips
    source : of the current terrain; without one it stays unknown
    settings : controller and its settings
    channels : of each stream, in the order of the columns of the samples that :meth:`take` is given; by default those
        of :func:`~terrain.kinematics.logged_wheels.sensor_channels`, and what is not among them is unknown.  Where the
        steering of a swerve robot is measured, :meth:`take` begins with it where it stands

    Raises
    ------
    ConfigError
        if the controller is unknown, a setting is not accepted, the table is another robot's, or the gains
        make the loop unstable in the robot's range of operation.

    Examples
    --------
    >>> from terrain.control.traction import TractionStatus
    >>> from terrain.robots import load_robot
    >>> pilot = LivePilot(load_robot("agrimaro"), load_slip_table())
    >>> command = pilot.step(Sample(0.0, np.array([0.5, 0.0, 0.0]), {}))  # nothing is known yet
    >>> command.wheel_radps, command.status["status_code"] == TractionStatus.UNSOUND
    (array([0.1, 0.1, 0.1]), True)
    """

    name = "pilot"
    estimate: LiveEstimate | None
    _filter: Live | None
    _clocks: Clocks

    def __init__(
        self,
        robot: Robot,
        table: SlipTable | None = None,
        source: TerrainSource | None = None,
        settings: PilotSettings = DEFAULT_SETTINGS,
        channels: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        table = load_slip_table() if table is None else table
        check_pilot(robot, table, settings)
        driven, correction = correct_live(robot)
        super().__init__(robot.name, table, SWITCHING, Clocks())
        self.source = TerrainSource() if source is None else source
        taken = CHANNELS
        if driven.drive != "swerve":  # their estimator takes what there is
            given = sensor_channels(driven) if channels is None else channels
            taken = {stream: tuple(names) for stream, names in given.items()}
        channels = taken if channels is None else channels
        if settings.controller not in OPEN_LOOP:
            check_channels("wheels", driven.rate_channels, taken.get("wheels", ()))
            self._filter = live_estimator(driven, taken, correction)
        self.control = RobotControl(driven, table, settings, self.filter_states, taken)
        self._steering_zeros_rad = np.array(driven.steering_zeros_rad)
        self._columns = {
            stream: None if tuple(channels[stream]) == names else places_among(names, list(channels[stream]))
            for stream, names in taken.items()
            if stream in channels
        }
        self._awaits_steering = "steering" in channels and driven.drive == "swerve"
        self._time_s, self._standing_rad = math.nan, self.control.steer_rad

    def replace(self, model: TerrainModel | None, table: SlipTable) -> None:
        """Go on with another model and table, as every chain."""
        super().replace(model, table)
        self.control.use(table)

    def restore(self, state: LiveState, now_s: float) -> LiveState:
        """Start from a saved state, as every chain."""
        fresh = super().restore(state, now_s)
        self.control.target_ratio = fresh.target_ratio
        return fresh

    @property
    def filter_states(self) -> tuple[str, ...]:
        """Names of the states of its estimates, in the order of their means; none of a controller without."""
        return () if self._filter is None else self._filter.states

    @property
    def target_ratio(self) -> float:
        """Target slip in traction that is aimed for; NaN before the first step."""
        return self.control.target_ratio

    @property
    def health(self) -> dict[str, str]:
        """Health of each sensor at the last step, by name, as those of ``Health`` in small letters."""
        found = zip(self.control.sensors, self.control.health, strict=True)
        return {name: Health(status).name.lower() for name, status in found}

    def take(self, sample: Sample) -> Step:
        """Return the command for a sample: to stand, where nothing is known yet or the step fails."""
        readings = {name: reading for name, reading in sample.readings.items() if name in self._columns}
        for name, reading in readings.items():
            if (places := self._columns[name]) is not None:  # NaN where a channel is not sent, at place -1
                given = np.column_stack([reading.values, np.full(len(reading.values), math.nan)])
                readings[name] = reading._replace(values=given[:, places])
        if self._awaits_steering and "steering" in readings and len(readings["steering"].values):
            measured_rad = readings["steering"].values[-1]
            if np.isfinite(measured_rad).all():
                self._standing_rad = self.control.steer_rad = measured_rad - self._steering_zeros_rad
                self._awaits_steering = False
        if math.isnan(sample.time_s) or self._awaits_steering:
            return Step((), self._standing(), CommandStatus.NO_SAMPLES)
        try:
            command = self.step(sample._replace(readings=readings))
        except Exception as error:  # a robot without a command would go on with its last one
            failure = f"a step failed: {type(error).__name__}: {error}"
            return Step((), self._standing(), CommandStatus.FAILED, failure)
        windows, status = self.source.outputs, CommandStatus.OK
        figures = (*command.wheel_radps.tolist(), *command.steer_rad.tolist(), *command.twist.tolist())
        if not all(map(math.isfinite, figures)):
            command, status = self._standing()._replace(status=command.status), CommandStatus.NOT_FINITE
        self._standing_rad = command.steer_rad
        return Step(windows, command, status)

    def _standing(self) -> Command:
        """Return the command to stand, steered as before."""
        status = {"status_code": float(TractionStatus.UNSOUND)}
        return Command(np.zeros(len(self._standing_rad)), self._standing_rad, np.zeros(3), status)

    def step(self, sample: Sample) -> Command:
        """Return the wheels' commands for a sample; whatever arrives, it does not raise.

        Parameters
        ----------
        sample : readings since the step before, in the order of the schema, and the desired twist

        Returns
        -------
        Command
            its ``status`` are the channels of the stream ``control``, as ``RobotControl.step`` gives them
        """
        time_s, readings = self._clocks.step(
            getattr(sample, "time_s", None), getattr(sample, "readings", None)
        )
        dt_s = PERIOD_S if math.isnan(self._time_s) else time_s - self._time_s
        self._time_s, output = time_s, OutputStatus.NONE
        terrain, desired = getattr(sample, "terrain", ""), finite_twist(getattr(sample, "twist", None))
        if self._filter is not None:
            self.control.measured(time_s, dt_s, readings, self.estimate)
            estimates = self._filter.step(readings, time_s)
            self.estimate = self._filter.at(time_s)
            before = self.belief.terrain
            taken = Sample(time_s, desired, readings, terrain if isinstance(terrain, str) else "")
            output = self._believe(taken, estimates)
            if self.belief.terrain != before:
                self.control.reset_terrain()
        command, self.belief = self.control.step(
            time_s, dt_s, desired, self.estimate, self.belief, output, holds=self.source.certain
        )
        return command
