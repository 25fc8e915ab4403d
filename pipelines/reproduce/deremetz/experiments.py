"""The experiments of Deremetz et al., ICRA 2017, on simulated drives, in the order of the page."""

from __future__ import annotations

from pipelines.reproduce.deremetz.grip import grip_preview
from pipelines.reproduce.deremetz.misprints import misprints
from pipelines.reproduce.deremetz.slopes import slopes
from pipelines.reproduce.deremetz.stiffness import stiffness
from pipelines.reproduce.deremetz.stop import stop
from pipelines.reproduce.results import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment("Stop at 3 m/s (Figs. 4 to 6)", stop),
    Experiment("Bends and slopes of 15 degrees (Figs. 7 to 10)", slopes),
    Experiment("Cornering stiffness", stiffness),
    Experiment("Equations as printed", misprints),
    Experiment("Adapted stiffness in the prediction (VII, future work)", grip_preview),
)
