"""``terrain can``: a pilot on a CAN bus."""

from __future__ import annotations

import numpy as np

from pipelines.can_bridge.bridge import Bridge, latency_of
from pipelines.can_bridge.core import BridgeCore, MakeStep, Step
from pipelines.can_bridge.link import Link, open_bus
from pipelines.can_bridge.results import BridgeReport
from pipelines.can_bridge.settings import CanSettings
from pipelines.data.can_codec import load_layout
from pipelines.data.can_signals import OPTIONAL, SIGNALS
from pipelines.live.classifying import ClassifierThread
from pipelines.live.pilot import LivePilot
from pipelines.live.pilot_settings import PilotSettings
from pipelines.live.terrain_source import Classifier
from pipelines.reporting.stopping import stopping
from terrain.control.slip_table import load_slip_table
from terrain.records import Array
from terrain.robots import SwerveRobot, as_drive, load_robot

REQUIRED = tuple(name for name, channels in SIGNALS.items() if not set(channels) <= OPTIONAL)
"""Streams without which a pilot makes no correction."""


def run_can(settings: CanSettings) -> BridgeReport:
    """Run a pilot on a bus until it is interrupted, or for the time of the settings.

    Raises
    ------
    TerrainError
        if robot, table, model or DBC are not accepted, or the bus cannot be opened.
    """
    layout = load_layout(settings.dbc, REQUIRED)
    robot = as_drive(
        SwerveRobot,
        load_robot(settings.robot),
        "robot {name}: drive {drive!r} has no pilot, only 'swerve' has",
    )
    core = BridgeCore(layout, robot, _pilot(settings))
    link = Link(lambda: open_bus(settings.interface, settings.channel, settings.bitrate))
    bridge = Bridge(core, link, settings.rate_hz)
    with stopping(bridge.stop):
        bridge.run(settings.duration_s)
    return BridgeReport(
        interface=settings.interface,
        channel=settings.channel,
        dbc=layout.name,
        robot=robot.name,
        duration_s=round(bridge.duration_s, 3),
        frames_in=core.n_in,
        frames_used=core.n_used,
        frames_out=link.n_out,
        samples=dict(sorted(core.samples.items())),
        dropped=dict(sorted((core.dropped + core.failed).items())),
        bus_errors=dict(sorted(link.errors.items())),
        clipped=dict(sorted(core.clipped.items())),
        states=dict(sorted(core.states.items())),
        ticks_missed=bridge.ticks_missed,
        wheels_to_correction=latency_of(core.latencies_s),
        step=bridge.step,
    )


def _pilot(settings: CanSettings) -> MakeStep:
    """Return what makes the step of the pilot that the settings describe; what is not accepted is refused."""
    robot, table = load_robot(settings.robot), load_slip_table(settings.table)
    source = None
    if settings.model is not None:
        from pipelines.models.tracking import load_model

        source = Classifier(load_model(settings.model), robot, ClassifierThread().robot())
    pilot_settings = PilotSettings(controller=settings.controller)

    def make(steer_rad: Array) -> Step:
        return LivePilot(robot, table, source, pilot_settings, steer_rad=steer_rad).step

    make(np.zeros(3))  # before the bus is opened
    return make
