"""The experiments of Danzi, AgriMaRo thesis, on simulated runs, in the order of the page."""

from __future__ import annotations

from pipelines.reproduce.danzi.adaptive_tuning import adaptive_tuning
from pipelines.reproduce.danzi.admissible_twists import admissible_twists
from pipelines.reproduce.danzi.blind_filters import blind_filters
from pipelines.reproduce.danzi.camera_frames import camera_frames
from pipelines.reproduce.danzi.camera_lost import camera_lost
from pipelines.reproduce.danzi.classify_terrain import classify_terrain
from pipelines.reproduce.danzi.dead_band import dead_band
from pipelines.reproduce.danzi.innovations import innovations
from pipelines.reproduce.danzi.slip_bias import slip_bias
from pipelines.reproduce.danzi.slip_on_terrains import slip_on_terrains
from pipelines.reproduce.danzi.start_transients import start_transients
from pipelines.reproduce.danzi.traction_control import traction_control
from pipelines.reproduce.results import Experiment

EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment("Admissible twists (2.3.2)", admissible_twists),
    Experiment("Filters without a camera (4.3 to 4.6)", blind_filters),
    Experiment("Adaptive tuning (4.6.1)", adaptive_tuning),
    Experiment("Frames of the camera (5.2.3)", camera_frames),
    Experiment("Dead band of the steering (6.1.1)", dead_band),
    Experiment("Innovations in a complex drive on tiles (6.2)", innovations),
    Experiment("Transients with delayed encoders (7.2.2)", start_transients),
    Experiment("Slip on three terrains (7.2.3)", slip_on_terrains),
    Experiment("Bias by the zero-slip wheel rows (6.1)", slip_bias),
    Experiment("Loss of the camera (6.1)", camera_lost),
    Experiment("Terrain recognition (8.1)", classify_terrain),
    Experiment("Traction control, case by case (8.3.2)", traction_control),
)
