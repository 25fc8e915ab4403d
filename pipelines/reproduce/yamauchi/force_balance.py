"""Fig. 3 of Yamauchi et al.: resistances of compaction and of the grade; equations as they are printed."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.figure import Figure

from pipelines.reporting.drawing import BLUE, CLASS_COLOURS
from pipelines.reproduce.results import Finding, Picture, Row, equation_verdict, holds
from pipelines.reproduce.yamauchi.figures import Mark, Panel, panels_figure
from pipelines.reproduce.yamauchi.trials import SAND, patako
from terrain.estimation.observers.slip_model import N_PARAMETERS, SIDE, body_velocity
from terrain.records import Array
from terrain.terramechanics.resistance import bekker_pressure, plate_sinkage
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.track import track_balance
from terrain.terramechanics.traction import mobilised_ratio

SOILS = (SAND, "dry_sand", "tilled_loam", "clay")
STEEPEST_DEG = 25.0
INDEPENDENT_RATIO = 0.05
"""Fall of the compaction over the rise of the grade's pull, up to which it counts as independent."""


def force_balance(seed: int, quick: bool) -> Finding:
    """Compare resistances over the slope, and corrected equations with printed ones."""
    robot = patako()
    slopes = np.radians(np.linspace(0.0, STEEPEST_DEG, 26))
    found = {
        name: [track_balance(robot, load_soil(name), float(slope)) for slope in slopes] for name in SOILS
    }
    compaction = {name: np.array([each.compaction_n for each in row]) for name, row in found.items()}
    grade = np.array([each.grade_n for each in found[SAND]])
    changes = {name: float((row[0] - row[-1]) / grade[-1]) for name, row in compaction.items()}
    fallen = float(compaction[SAND][-1] / compaction[SAND][0])
    row = Row(
        what=f"Fall of the compaction resistance from 0° to {STEEPEST_DEG:g}° over the rise of the "
        "grade's, largest of four soils",
        where="fig. 3",
        printed="largely independent of the slope",
        simulated=max(changes.values()),
        unit="ratio",
        verdict=holds(max(changes.values()) < INDEPENDENT_RATIO),
        why="The load on the ground falls with the cosine of the slope, and the compaction a little "
        f"faster: on the sand to {fallen:.2f} of its {compaction[SAND][0]:.1f} N, while the grade comes "
        f"to pull with {grade[-1]:.0f} N.",
        beside=changes,
    )
    return Finding([row, *_equations()], [Picture(_CAPTION, _figure(np.degrees(slopes), compaction, grade))])


_CAPTION = (
    "Resistance of compaction and of the grade over the slope, of Patako (25 kg) on four soils, by (8) "
    "with the n-th root and (10) with the grade. The soils are those of this project, Toyoura sand with "
    "the moduli of dry sand; the paper's figure has sand, snow, loam and a lunar simulant."
)


def _figure(x: Array, compaction: dict[str, Array], grade: Array) -> Figure:
    marks = [Mark(x, grade, BLUE, "grade", dashed=True)]
    colours = CLASS_COLOURS[1:]
    marks += [
        Mark(x, row, colour, name.replace("_", " "), dashed=name == SAND)
        for (name, row), colour in zip(compaction.items(), colours, strict=False)
    ]
    return panels_figure(
        "Resistance over the slope",
        [
            Panel("grade and compaction", "slope [deg]", "resistance [N]", marks),
            Panel("compaction", "slope [deg]", "resistance [N]", marks[1:]),
        ],
    )


def _equations() -> list[Row]:
    """Return rows on equations that are printed wrong."""
    sand, robot = load_soil(SAND), patako()
    width, n = robot.track_width_m, sand.sinkage_exponent_ratio
    pressure = 1300.0
    numbers = (width, sand.kc_npmn1, sand.kphi_npmn2, n)
    depth = float(plate_sinkage(pressure, *numbers))
    printed = n * math.sqrt(pressure / (sand.kc_npmn1 / width + sand.kphi_npmn2))
    carried = [float(bekker_pressure(each, *numbers)) / pressure for each in (depth, printed)]
    x = 0.5
    sheared = 1.0 - (1.0 - math.exp(-x)) / x
    theta, slopes = np.zeros(N_PARAMETERS), np.empty((2, N_PARAMETERS))
    theta[SIDE] = 0.5
    drift = body_velocity(theta, robot.half_track_m, (-0.05, -0.05), 0.0, (0.1, 0.0), 0.0, slopes)[1]
    right = -0.05 * math.tan(math.atan(0.05))
    return [
        Row(
            what="Pressure that soil carries at the sinkage of (8), over the pressure on it",
            where="(8)",
            printed=f"{carried[1]:.2g}",
            simulated=carried[0],
            unit="ratio",
            verdict=equation_verdict(carried[0], 1.0, carried[1]),
            why="(8) prints n times a root; it is the n-th root.",
        ),
        Row(
            what="Thrust over its limit at a slip of K / (2 l)",
            where="(17), (19)",
            printed=f"{1.0 - math.exp(-x) / x:.3f}",
            simulated=float(mobilised_ratio(x)),
            unit="ratio",
            verdict=equation_verdict(float(mobilised_ratio(x)), sheared, 1.0 - math.exp(-x) / x),
            why="The integral of (14) is 1 - (1 - exp(-x)) / x; the printed 1 - exp(-x) / x falls "
            "without limit towards a slip of 0.",
        ),
        Row(
            what="Sideways drift in reverse at 5 cm/s, left side 0.1 rad up, of a slope of (26) of 0.5",
            where="(2), (26)",
            printed=f"{-1e3 * right:.3g} (uphill)",
            simulated=1e3 * drift,
            unit="mm/s",
            verdict=equation_verdict(drift, right, -right),
            why="V_y = V_x tan(beta) turns uphill in reverse; gravity sets the sign, V_y = -|V_x| k roll.",
        ),
    ]
