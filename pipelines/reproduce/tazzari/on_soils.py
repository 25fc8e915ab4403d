"""Assumption 1 and (7) of Tazzari et al.: slip by the forces under the tracks, on homogeneous soil."""

from __future__ import annotations

import numpy as np

from pipelines.reporting.drawing import BLUE, INK, VERMILION
from pipelines.reporting.line_figure import Line
from pipelines.reproduce.results import Finding, Picture, Row, Verdict, holds
from pipelines.reproduce.tazzari.figures import Panel, panels_figure
from pipelines.reproduce.tazzari.runs import (
    MOTIONS,
    ObservedRun,
    TrackMotion,
    constant_speeds,
    observed,
    orchard_ugv,
    rms,
)
from terrain.constants import GRAVITY_MPS2
from terrain.simulation.tracked.contact import (
    COHESION,
    EXPONENT,
    KC,
    KPHI,
    ROLLING,
    TAN_FRICTION,
    WIDTH,
    contact_array,
    sinkage_of,
)
from terrain.simulation.tracked.run import QUIET
from terrain.terramechanics.resistance import compaction_resistance
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import friction_limit, janosi_slip

SOIL = "grass"
SETTLED_S = 30.0


def on_soils(seed: int, quick: bool) -> Finding:
    """Drive both motions at constant speeds on a soil, where the slip is that of the forces."""
    soil = load_soil(SOIL)
    runs = {
        motion: observed(soil, constant_speeds(motion, 60.0 if quick else 120.0), seed) for motion in MOTIONS
    }
    exact = {motion: observed(soil, constant_speeds(motion, 60.0), seed, sensors=QUIET) for motion in MOTIONS}
    rows = [row for motion in MOTIONS for row in _rows(motion, runs[motion], exact[motion])]
    return Finding([*rows, _inverse_row(soil, exact[MOTIONS[1]])], [_picture(runs, exact)])


def _rows(motion: TrackMotion, run: ObservedRun, exact: ObservedRun) -> list[Row]:
    steady = exact.eta[exact.time_s > 10.0]
    late = run.time_s > SETTLED_S
    off = run.estimate[late] - np.mean(steady, axis=0)
    side_mps = float(exact.run.streams["truth"].channel("speed_y_mps")[-1])
    return [
        Row(
            what=f"Change of the true efficiencies at constant speeds on {SOIL}, {motion.words}",
            where="assumption 1",
            printed="constant on homogeneous soil",
            simulated=float(np.ptp(steady, axis=0).max()),
            unit="ratio",
            verdict=holds(float(np.ptp(steady, axis=0).max()) < 0.002),
            why="By the forces under the tracks, after 10 s: range of what each track brings to the ground.",
            beside={"left": float(steady[-1, 0]), "right": float(steady[-1, 1])},
        ),
        Row(
            what=f"Speed sideways of the middle of the vehicle on {SOIL}, {motion.words}",
            where="(1)",
            printed="none",
            simulated=side_mps,
            unit="m/s",
            verdict=holds(abs(side_mps) < 1e-6),
            why="By the forces under the tracks. (1) lets a vehicle move only where it heads, which "
            "a vehicle on tracks does only in straight motion on the level.",
        ),
        Row(
            what=f"Error of the efficiencies on {SOIL}, {motion.words}",
            where="V",
            printed="not given",
            simulated=rms(off),
            unit="ratio",
            verdict=Verdict.NOT_PRINTED,
            why="Root mean square with raw fixes after 30 s. Motion sideways is no part of (5), and biases "
            "the efficiencies a little.",
            beside={
                "mean error, left": float(off[:, 0].mean()),
                "mean error, right": float(off[:, 1].mean()),
            },
        ),
    ]


def _inverse_row(soil: Soil, run: ObservedRun) -> Row:
    """Return the slip in straight motion by inverting (7) for the resistance of a track."""
    robot = orchard_ugv()
    contact = contact_array(robot, soil)
    load_n = 0.5 * robot.mass_kg * GRAVITY_MPS2
    resistance_n = contact[ROLLING] * load_n
    if contact[KPHI] > 0.0:
        modulus = contact[KC] + contact[WIDTH] * contact[KPHI]
        resistance_n += compaction_resistance(sinkage_of(contact, load_n), modulus, contact[EXPONENT])
    area_m2 = robot.contact_length_m * robot.track_width_m
    limit_n = friction_limit(load_n, area_m2, contact[COHESION], contact[TAN_FRICTION])
    slip = float(janosi_slip(resistance_n, limit_n, robot.contact_length_m, soil.shear_modulus_m))
    simulated = float(np.mean(1.0 - run.eta[-1]))
    return Row(
        what=f"Slip in straight motion on {SOIL}, (7) inverted for the resistance of a track",
        where="(7)",
        printed="slip from traction force",
        simulated=slip,
        unit="ratio",
        verdict=holds(abs(slip - simulated) < 0.02 * simulated),
        why="In closed form, with Lambert's function, for rolling friction and compaction; the simulated "
        "vehicle balances the forces of 16 elements of each track.",
        beside={"simulated vehicle": simulated},
    )


def _picture(runs: dict[TrackMotion, ObservedRun], exact: dict[TrackMotion, ObservedRun]) -> Picture:
    panels = [
        Panel(
            "time [s]",
            "efficiency",
            [
                Line(exact[motion].time_s[50:], exact[motion].eta[50:, 0], INK, "true"),
                Line(exact[motion].time_s[50:], exact[motion].eta[50:, 1], INK, "_true"),
                Line(run.time_s, run.estimate[:, 0], BLUE, "left"),
                Line(run.time_s, run.estimate[:, 1], VERMILION, "right"),
            ],
        )
        for motion, run in runs.items()
    ]
    return Picture(
        f"Efficiencies on {SOIL} by the forces under the tracks, on the circle (left) and in straight motion "
        "(right).",
        panels_figure(f"Efficiencies on {SOIL}", panels),
    )
