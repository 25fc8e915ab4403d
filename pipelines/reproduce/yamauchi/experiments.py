"""The experiments of Yamauchi et al., ROBOMECH Journal 2017, on simulated runs, in the order of the page."""

from __future__ import annotations

from pipelines.reproduce.results import Experiment
from pipelines.reproduce.yamauchi.force_balance import force_balance
from pipelines.reproduce.yamauchi.online import online
from pipelines.reproduce.yamauchi.slip_angle import slip_angle
from pipelines.reproduce.yamauchi.straight_slip import straight_slip
from pipelines.reproduce.yamauchi.turning_law import turning_law
from pipelines.reproduce.yamauchi.turning_odometry import turning_odometry

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment("Forces on a slope (fig. 3) and printed equations", force_balance),
    Experiment("Experiment I: straight motion (figs. 9 to 11)", straight_slip),
    Experiment("Experiment II: slip ratios in turns (figs. 7 and 13)", turning_law),
    Experiment("Experiment II: slip angle in turns (tables 3 and 4)", slip_angle),
    Experiment("Experiment III: odometry in turns (figs. 14 to 18)", turning_odometry),
    Experiment("Future work: identification while driving", online),
)
