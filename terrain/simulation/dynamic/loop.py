"""The closed loop: a controller gets what the sensors have written so far, and commands the wheels.

At instant ``t_k`` of the scenario the step that starts there has run with the command in force, so a sample
stamped ``t_k`` of a sensor without latency is there; the command of the controller is in force from the step
that starts a delay later, one step at the least.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping

import numpy as np

from terrain.errors import DataError, LogError
from terrain.logs.schema import unit_of
from terrain.records import Array, Command, Sample
from terrain.simulation.dynamic.plant import Plant
from terrain.simulation.dynamic.step import advance
from terrain.simulation.scenario.scenario import Scenario
from terrain.simulation.sensors.motion import N_BODY_RECORD, WHEEL_RECORD, Motion
from terrain.simulation.sensors.sensor import Sensor

_PATCHES = slice(N_BODY_RECORD + WHEEL_RECORD.index("patch_ratio"), None, len(WHEEL_RECORD))


class Drive:
    """A plant that is driven on and on, by commands that come into force one after the other.

    Parameters
    ----------
    plant, state, road_noise, record : as :func:`terrain.simulation.dynamic.step.advance` takes them, for
    all steps
    """

    def __init__(self, plant: Plant, state: Array, road_noise: Array, record: Array) -> None:
        self._plant, self._state, self._noise, self._record = plant, state, road_noise, record
        self._wheel, self._steer = np.zeros((1, 3)), np.zeros((1, 3))
        self._due: deque[tuple[int, Array, Array]] = deque()
        self._n_steps = 0

    def command(self, step: int, wheel_radps: Array, steer_rad: Array) -> None:
        """Let a command (3,), (3,) come into force with a step, not before those that were given before."""
        self._due.append((step, wheel_radps, steer_rad))

    def until(self, n_steps: int) -> bool:
        """Drive until so many steps are done; false where the state is not finite: the rest of it is NaN."""
        while self._n_steps < n_steps:
            first = self._n_steps
            if self._due and self._due[0][0] <= first:
                _, self._wheel[0], self._steer[0] = self._due.popleft()
                continue
            end = min(n_steps, self._due[0][0]) if self._due else n_steps
            held = (self._wheel, self._steer, end - first, self._noise[first:end], self._record[first:end])
            advance(self._plant, self._state, *held)
            self._n_steps = end
        finite = bool(np.isfinite(self._state).all())
        if not finite:
            self._record[self._n_steps :] = np.nan
            self._n_steps = len(self._record)
        return finite


def in_loop(
    controller: Callable[[Sample], Command],
    delay_steps: int,
    scenario: Scenario,
    substeps: int,
    drive: Drive,
    motion: Motion,
    sensors: Mapping[str, Sensor],
) -> tuple[Array, dict[str, Array]]:
    """Drive a scenario by a controller, to its last row.

    Parameters
    ----------
    controller : called once an instant of the scenario
    delay_steps : from an instant to when its command is in force; taken as one where it is none
    scenario, substeps : what is required, and how many steps pass from instant to instant
    drive, motion : over the same record, nothing driven yet; a motion that cannot be integrated ends in NaN
    sensors : of the motion, by stream

    Returns
    -------
    decided : (n, 9) twist, wheel rates and steering angles of each command
    status : (n,) by name

    Raises
    ------
    DataError
        if a command or its status is not what is required.
    """
    decided = np.empty((len(scenario.time_s), 9))
    status: list[Mapping[str, float]] = []
    for k, time_s in enumerate(scenario.time_s.tolist()):
        step = k * substeps
        if not drive.until(step + 1):
            break
        motion.grow(step + 1)
        for sensor in sensors.values():
            sensor.update()
        arrived = ((name, sensor.arrived(time_s)) for name, sensor in sensors.items())
        readings = {name: reading for name, reading in arrived if reading is not None}
        one, two, three = motion.record[step, _PATCHES].tolist()
        terrain = scenario.patches[int(one)].terrain if one == two == three else ""
        command = controller(Sample(time_s, scenario.twist[k], readings, terrain))
        decided[k] = _numbers(command, time_s)
        status.append(_status(command, status[0] if status else None, time_s))
        drive.command(step + max(delay_steps, 1), decided[k, 3:6], decided[k, 6:])
    drive.until(len(motion.record))
    names = status[0] if status else ()
    return decided, {name: np.array([row[name] for row in status]) for name in names}


def _numbers(command: Command, time_s: float) -> Array:
    """Return twist, wheel rates and steering angles of a command in a row (9,)."""
    row = np.empty(9)
    for i, name in enumerate(("twist", "wheel_radps", "steer_rad")):
        given = getattr(command, name)
        try:
            values = np.asarray(given, dtype=float)
        except (TypeError, ValueError):
            values = np.empty(0)
        if values.shape != (3,) or not np.isfinite(values).all():
            shown = " ".join(repr(given).split())
            raise DataError(
                f"controller: {name} of its command at {time_s:g} s is {shown}, 3 finite numbers are required"
            )
        row[3 * i : 3 * i + 3] = values
    return row


def _status(command: Command, first: Mapping[str, float] | None, time_s: float) -> dict[str, float]:
    """Return the status of a command; ``first`` is that of the first one."""
    try:
        status = {name: float(value) for name, value in command.status.items()}
        if first is None:
            for name in status:
                unit_of(name)
    except (AttributeError, TypeError, ValueError, LogError) as error:
        raise DataError(f"controller: status of its command at {time_s:g} s: {error}") from None
    if first is not None and status.keys() != first.keys():
        raise DataError(
            f"controller: status of its command at {time_s:g} s has {', '.join(status) or 'nothing'}, "
            f"that of the first has {', '.join(first) or 'nothing'}: the same names are required"
        )
    return status
