"""What the first half of each drive states of a robot, held against the second half: shared by the scripts here."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pipelines.explain.explain import explain
from terrain.calibration.finding import Finding
from terrain.calibration.motion import MotionFit, findings_by, fit_motion, leg_errors
from terrain.effects import PARAMETER
from terrain.errors import TerrainError
from terrain.extension import extended_yaml
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.records import RunLog, Stream
from terrain.robots import Robot, load_robot


def asked(folder: str, about: str) -> argparse.Namespace:
    """Return the arguments of a script: the data folder, $TERRAIN_DATA/FOLDER by default, and where pages go."""
    parser = argparse.ArgumentParser(description=about)
    root = os.environ.get("TERRAIN_DATA")
    default = Path(root) / folder if root else None
    parser.add_argument("data", nargs="?" if default else None, default=default, type=Path)
    parser.add_argument("--out", type=Path, help="folder of the extended robot and the page; none by default")
    return parser.parse_args()


def halves(runs: Sequence[RunLog]) -> tuple[list[RunLog], list[RunLog]]:
    """Return the first and the second half of each run."""
    first, second = list[RunLog](), list[RunLog]()
    for run in runs:
        middle_s = (run.start_s + run.end_s) / 2.0
        for half, name in ((first, "first"), (second, "second")):
            streams = {}
            for key, stream in run.streams.items():
                kept = stream.time_s < middle_s if half is first else stream.time_s >= middle_s
                streams[key] = Stream(stream.time_s[kept], stream.values[kept], stream.channels)
            half.append(RunLog(f"{run.run_id}_{name}", run.robot, streams))
    return first, second


def verdict(stated: Finding, checked: Finding) -> str:
    """Return whether a number of the first half holds on the second, in words."""
    if not stated.determined:
        return "not shown by the first half"
    if not checked.determined:
        return "not shown by the second half"
    half = np.hypot(stated.high - stated.low, checked.high - checked.low) / 2.0
    holds = abs(stated.value - checked.value) <= half
    return "holds" if holds else "DOES NOT HOLD"


def interval(found: Finding) -> str:
    """Return value and interval of a number."""
    return f"{found.value:9.4g} ({found.low:.4g} to {found.high:.4g})" if found.determined else "        -"


def table(first: Sequence[Finding], second: Sequence[Finding], whole: Sequence[Finding]) -> list[str]:
    """Print the numbers of both halves and of all, and return the verdicts."""
    print(f"{'number':22}{'first half':36}{'second half':36}{'all':36}verdict")
    verdicts = []
    for one, other, both in zip(first, second, whole, strict=True):
        verdicts.append(verdict(one, other))
        name = one.parameter.partition(".")[2]
        print(f"{name:22}{interval(one):36}{interval(other):36}{interval(both):36}{verdicts[-1]}")
    return verdicts


def extended(fitted: MotionFit, robot: Robot, out: Path) -> Path:
    """Write the robot with what its poses show built in, and return the file.

    Poses that are early, as of clocks that differ, are no property of the robot, and slip is the ground's.
    """
    within = [
        name in PARAMETER
        and PARAMETER[name].low <= value <= PARAMETER[name].high
        and name != "force_slip_ratio"
        for name, value in fitted.values.items()
    ]
    shown = [i for i, seen in enumerate(fitted.fit.identified) if seen and within[i]]
    names = [fitted.names[i] for i in shown]
    values = {name: float(fitted.fit.value[i]) for name, i in zip(names, shown, strict=True)}
    ends = {name: tuple(fitted.fit.interval[:, i].tolist()) for name, i in zip(names, shown, strict=True)}
    text = extended_yaml(robot.name, values, fitted.fit.cov[np.ix_(shown, shown)], ends, "legs between poses")
    ensure_writable(out)
    atomic_write(out / f"{robot.name}.yaml", text)
    return out / f"{robot.name}.yaml"


def show(runs: Sequence[RunLog], robot: Robot, out: Path | None) -> list[str]:
    """Print what poses show of a robot with the verdict of the second half; write robot and page where asked to."""
    first, second = halves(runs)
    fits = {
        name: fit_motion(part, robot) for name, part in (("first", first), ("second", second), ("all", runs))
    }
    found = {name: findings_by(fit, robot) for name, fit in fits.items()}
    print(
        f"{robot.name}, drive {robot.drive!r}, {len(runs)} recorded drive(s); 95 % intervals by blocks of time"
    )
    verdicts = table(found["first"], found["second"], found["all"])
    for name, values in (("described", {}), ("of the first half", fits["first"].values)):
        errors = leg_errors(second, robot, values)
        size = np.median(np.hypot(*errors[:, :2].T)), np.degrees(np.median(np.abs(errors[:, 2])))
        print(f"legs of 1 s of the second half, numbers {name}: off by {size[0]:.3f} m, {size[1]:.2f} deg")
    if out is not None:
        file = extended(fits["all"], robot, out)
        result = explain(runs, load_robot(file), data=robot.name, description=str(file))
        result.report.save(out / "report.html")
        print(f"robot and page: {file}, {out / 'report.html'}\nbeyond these numbers: {result.report.answer}")
    return verdicts


def answer(folder: str, about: str, main: Callable[[Path, Path | None], list[str]]) -> None:
    """Run a script: mistakes of the user are one sentence."""
    arguments = asked(folder, about)
    try:
        main(arguments.data, arguments.out)
    except TerrainError as error:
        sys.exit(f"error: {error}")
