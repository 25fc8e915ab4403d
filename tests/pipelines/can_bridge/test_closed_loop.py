"""A simulated robot on one side of a virtual bus, the bridge on the other: the loop is closed over CAN."""

import uuid

import can
import numpy as np
import pytest

from pipelines.can_bridge.core import BridgeCore
from pipelines.can_bridge.link import Link
from pipelines.data.can_codec import Frame, decode, encode, load_layout
from pipelines.data.can_signals import as_sent
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings
from terrain.control.drive_metrics import drive_history, slip_peak
from terrain.control.situations import SituationOptions, make_situation
from terrain.control.slip_table import load_slip_table
from terrain.records import Command
from terrain.robots import load_robot
from terrain.simulation.dynamic.simulate import simulate

LAYOUT, ROBOT, TABLE = load_layout(), load_robot("agrimaro"), load_slip_table()
RESOLUTION_RADPS = 0.0005


class RobotSide:
    """The Teensy: sends samples and the desired twist, adds corrections to its own kinematics.

    Parameters
    ----------
    half_turned : wheels whose steering is at the other of the two solutions, with the opposite rate
    """

    def __init__(self, make_step, half_turned=()):
        channel = f"loop-{uuid.uuid4()}"
        self.bus = can.Bus(interface="virtual", channel=channel, preserve_timestamps=True)
        self.link = Link(lambda: can.Bus(interface="virtual", channel=channel))
        self.core = BridgeCore(LAYOUT, ROBOT, make_step)
        self._kinematics = LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="plain"))
        self._turn = np.isin(np.arange(3), half_turned)
        self._counters = dict.fromkeys(("wheels", "steering", "imu", "odometry", "twist"), 0)
        self.added, self.states = [], []

    def step(self, sample):
        for name, reading in sample.readings.items():
            for time_s, row in zip(reading.time_s, reading.values, strict=True):
                self._send(name, row, time_s)
        self._send("twist", sample.twist, sample.time_s)
        while (frame := self.link.receive(0.0)) is not None:
            self.core.receive(frame, sample.time_s)
        assert self.link.send(self.core.tick(sample.time_s))
        self.core.sent(sample.time_s)
        return self._command(sample)

    def _send(self, name, row, time_s):
        row = np.array(row)
        if name == "steering":
            row += np.pi * self._turn
        if name == "wheels":
            row[:3] *= np.where(self._turn, -1.0, 1.0)
        for frame in encode(LAYOUT, name, as_sent(name, row), self._counters[name]):
            message = can.Message(
                arbitration_id=frame.arbitration_id,
                data=frame.data,
                is_extended_id=False,
                timestamp=float(time_s),
            )
            self.bus.send(message)
        self._counters[name] += 1

    def _command(self, sample):
        theory = self._kinematics.step(sample)
        received = [self.bus.recv(0), self.bus.recv(0)]
        assert self.bus.recv(0) is None
        parts = [decode(LAYOUT, Frame(m.timestamp, m.arbitration_id, bytes(m.data))) for m in received]
        added, status = np.array(parts[0].values), dict(zip(parts[1].columns, parts[1].values, strict=True))
        self.added.append(added)
        self.states.append(int(status[4]))
        sign = np.where(self._turn, -1.0, 1.0)
        return Command(theory.wheel_radps + sign * added, theory.steer_rad, theory.twist, {})

    def close(self):
        self.link.close()
        self.bus.shutdown()


@pytest.fixture
def on_bus():
    """Return a maker of robots on a bus, which are taken off it in the end."""
    made = []

    def make(**options):
        made.append(RobotSide(pilot_step("traction"), **options))
        return made[-1]

    yield make
    for side in made:
        side.close()


def pilot_step(controller):
    return lambda steer_rad: (
        LivePilot(ROBOT, TABLE, settings=PilotSettings(controller=controller), steer_rad=steer_rad).step
    )


def driven(controller):
    """A start that is commanded as a step, on grass."""
    where = make_situation("straight", ROBOT, "grass", 3, SituationOptions(accel_mps2=np.inf, duration_s=8.0))
    run = simulate(
        ROBOT,
        where.scenario,
        where.soils,
        where.seed,
        conditions=where.conditions,
        controller=controller,
        command_delay_s=0.04,
    )
    return run, slip_peak(drive_history(run, ROBOT, where.conditions.radius_factors))


@pytest.fixture(scope="module")
def plain():
    return driven(LivePilot(ROBOT, TABLE, settings=PilotSettings(controller="plain")).step)


def test_the_loop_over_can_drives_as_the_one_without(plain, on_bus):
    """Slip of a start is limited as without CAN, and the commands differ by little more than roundings."""
    direct, direct_peak = driven(pilot_step("traction")(np.zeros(3)))
    side = on_bus()
    run, peak = driven(side.step)
    assert peak == pytest.approx(direct_peak, abs=0.002)
    assert peak < 0.5 * plain[1]
    wheels = [f"wheel_{i}_radps" for i in (1, 2, 3)]
    for wheel in wheels:
        apart = run.streams["commands"].channel(wheel) - direct.streams["commands"].channel(wheel)
        assert np.abs(apart).max() < 10 * RESOLUTION_RADPS
        assert np.sqrt(np.mean(apart**2)) < 2 * RESOLUTION_RADPS
    assert np.abs(side.added).max() > 0.5
    assert set(side.states) == {0}
    assert not side.core.dropped
    assert not side.link.errors


def test_a_wheel_steered_to_the_other_solution_gets_the_opposite_correction(on_bus):
    """Half a turn away a wheel rolls backwards to go ahead: the loop is the same."""
    side, turned = on_bus(), on_bus(half_turned=(1,))
    peak, turned_peak = driven(side.step)[1], driven(turned.step)[1]
    assert np.abs(np.array(side.added)[:, 1] + np.array(turned.added)[:, 1]).max() < 10 * RESOLUTION_RADPS
    assert np.abs(np.array(side.added)[:, 0] - np.array(turned.added)[:, 0]).max() < 10 * RESOLUTION_RADPS
    assert turned_peak == pytest.approx(peak, abs=0.002)
