"""Whole recordings of DRIVE, a Husky and a Warthog: effective track, rolling radius and delays, by halves of each.

python examples/unseen/recordings.py [DATA/drive_recordings] [--out recordings]
"""

from pathlib import Path

from second_half import answer, table

from pipelines.data.datasets import load_runs
from pipelines.explain.explain import explain
from terrain.calibration.motion import findings_by, fit_motion
from terrain.files.atomic import ensure_writable
from terrain.records import RunLog
from terrain.robots import load_robot


def main(data: Path, out: Path | None = None) -> list[str]:
    """Print what the recordings of each robot and terrain show: the first half of the runs of each, and the second."""
    recorded, verdicts = list(load_runs(data)), list[str]()
    for name, terrain in sorted({(run.robot, *run.terrains[:1]) for run in recorded}):
        robot, first, second = load_robot(name), list[RunLog](), list[RunLog]()
        own = [run for run in recorded if run.robot == name and terrain in run.terrains]
        for session in sorted({run.session for run in own}):
            of_it = sorted((run for run in own if run.session == session), key=lambda run: run.run_id)
            first += of_it[: len(of_it) // 2]
            second += of_it[len(of_it) // 2 :]
        # the slip of soft ground is in the intervals
        parts = [findings_by(fit_motion(part, robot, "lidar"), robot) for part in (first, second, own)]
        print(
            f"{name} on {terrain}: {len(own)} runs of {len({run.session for run in own})} recordings; 95 % intervals"
        )
        verdicts += table(*parts)
        if out is not None:
            result = explain(own, robot, data="drive_recordings")
            ensure_writable(out)
            result.report.save(out / f"{name}_{terrain}.html")
            print(f"page: {out / f'{name}_{terrain}.html'}\n{result.report.answer}")
    return verdicts


if __name__ == "__main__":
    answer("drive_recordings", __doc__, main)
