"""The experiments of Tazzari et al., on simulated runs, in the order of the page."""

from __future__ import annotations

from pipelines.reproduce.results import Experiment
from pipelines.reproduce.tazzari.compensation import compensation
from pipelines.reproduce.tazzari.convergence import convergence
from pipelines.reproduce.tazzari.disturbances import disturbances
from pipelines.reproduce.tazzari.misprints import misprints
from pipelines.reproduce.tazzari.missing_fixes import missing_fixes
from pipelines.reproduce.tazzari.on_soils import on_soils
from pipelines.reproduce.tazzari.two_motions import two_motions

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment("Circular and straight motion (V, figures 3 to 5)", two_motions),
    Experiment("Convergence time and gains (V)", convergence),
    Experiment("Equations with misprints (IV)", misprints),
    Experiment("Disturbances (remark 1)", disturbances),
    Experiment("Slip by the forces under the tracks (II, III)", on_soils),
    Experiment("Missing fixes and rest (I)", missing_fixes),
    Experiment("Compensation of slip (VI, future work)", compensation),
)
