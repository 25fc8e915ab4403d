"""Future work of Deremetz et al.: the adapted cornering stiffness in the prediction."""

from __future__ import annotations

from pipelines.reproduce.deremetz.drives import FAST_MPS, FASTEST_MPS, MEDIUM_MPS, drives, over
from pipelines.reproduce.results import Finding, Picture, Row, Verdict
from pipelines.track.figures import lateral_figure, speed_figure
from terrain.control.car_evaluation import FollowedDrive
from terrain.control.car_scenarios import GRIP_RATIO


def grip_preview(seed: int, quick: bool) -> Finding:
    """Drive the trajectory of Fig. 7 with speed and steering previewed by the grip that was estimated."""
    rows = []
    for speed in (MEDIUM_MPS, FAST_MPS, FASTEST_MPS):
        found = drives("slope", speed, "multi-model with preview", seed, quick)
        largest, slowest = over(found, lambda drive: drive.lateral_max_m()), over(found, _slowest_mps)
        reached = sum(drive.reached_end for drive in found)
        beside = {"slowest speed in the bends [m/s]": slowest.mean, "bound, speed / 10": speed / 10.0}
        rows.append(
            Row(
                what=f"Largest lateral error at {speed:g} m/s with the preview",
                where="VII",
                printed="future work",
                simulated=largest.mean,
                spread=largest.spread,
                unit="m",
                verdict=Verdict.NOT_PRINTED,
                why=f"{reached} of {len(found)} drives reached the end. The secant stiffness shows how "
                "much of the grip is used; before bends the speed falls until three quarters of what is "
                "certain suffice, and the sideslip expected there is steered before it comes.",
                beside=beside,
            )
        )
    found = drives("slope", FASTEST_MPS, "multi-model with preview", seed, quick)
    grip, std = over(found, lambda one: float(one.grip_ratio[-1])), over(found, lambda one: one.grip_std[-1])
    rows.append(
        Row(
            what="Grip as estimated at the end of the drive at 6 m/s",
            where="VII",
            printed="not given",
            simulated=grip.mean,
            spread=grip.spread,
            unit="ratio",
            verdict=Verdict.NOT_PRINTED,
            why="From slip angles, speed, yaw rate and roll, of the stiffness that the tyre has at small "
            "slip.",
            beside={"simulated tyre": GRIP_RATIO, "standard deviation by the filter": std.mean},
        )
    )
    shown = {
        name: drives("slope", FASTEST_MPS, name, seed, quick)[0]
        for name in ("multi-model", "multi-model with preview")
    }
    return Finding(
        rows,
        [
            Picture(
                "6 m/s: lateral errors without and with the preview; without it the robot leaves the path.",
                lateral_figure(shown, FASTEST_MPS / 10.0, "6 m/s: lateral errors"),
            ),
            Picture(
                "6 m/s with the preview: speed and steering.",
                speed_figure(shown["multi-model with preview"], "6 m/s with the preview"),
            ),
        ],
    )


def _slowest_mps(drive: FollowedDrive) -> float:
    return float(drive.speed_mps[drive.between(15.0, 95.0)].min())
