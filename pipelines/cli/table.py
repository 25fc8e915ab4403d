"""The commands: group, name, module and line of help; and where former commands went.

A module of a command has ``EXAMPLE`` (a command line), ``Settings``, ``run(settings, progress)`` with a
result, and ``report(result)`` beside each kind of result.
"""

from __future__ import annotations

from typing import NamedTuple


class Command(NamedTuple):
    """One row: the group under which help lists it, its name, the module that has it, and a line of help."""

    group: str
    name: str
    module: str
    text: str


COMMANDS: tuple[Command, ...] = (
    Command(
        "Data", "convert", "pipelines.data.convert", "logs of any layout <-> run folders, MCAP, ROS bags, CSV"
    ),
    Command(
        "Data",
        "inspect",
        "pipelines.cli.inspect",
        "rates, gaps, clocks, units, signs; the card of a model",
    ),
    Command("Data", "simulate", "pipelines.data.simulate", "runs of a described robot"),
    Command("Data", "label", "pipelines.learn.label", "set, propose, answer"),
    Command(
        "State",
        "estimate",
        "pipelines.slip.estimate",
        "motion and slip, by a filter, an observer or a pose from outside",
    ),
    Command("State", "calibrate", "pipelines.slip.calibrate", "a robot, an odometry or a soil from logs"),
    Command(
        "Terrain",
        "crossval",
        "pipelines.learn.crossval",
        "recipes or models on runs and sessions held out, side by side",
    ),
    Command("Terrain", "train", "pipelines.learn.train", "evaluate, fit, track, register"),
    Command("Terrain", "predict", "pipelines.learn.predict", "terrain or unknown, target slip"),
    Command("Slip", "learn-slip", "pipelines.slip.learn_slip", "slip curves and target slips"),
    Command(
        "Reality",
        "explain",
        "pipelines.explain.explain",
        "what the simulation gets wrong, and the extended robot",
    ),
    Command(
        "Control",
        "drive",
        "pipelines.drive.drive",
        "controllers in closed loop, side by side; --faults, --path",
    ),
    Command("Live", "serve", "pipelines.serve.serve", "WebSocket, --can BUS, --replay LOG"),
    Command("Live", "quickstart", "pipelines.cli.quickstart", "all of it, on your runs or simulated ones"),
)

FORMER: dict[str, str] = {
    "can": "use terrain serve --can BUS",
    "replay": "use terrain serve --replay LOG",
    "import": "use terrain convert LOGS --out RUNS",
    "export": "use terrain convert RUNS --to mcap --out DIR",
    "model": "use terrain inspect MODEL",
    "bench": "use python tests/studies live, soak, scale or labels, in the repository",
    "explain-trials": "use python tests/studies trials, in the repository",
    "reproduce": "use python examples/papers PAPER, in the repository",
    "features": "use terrain crossval or train with --cache DIR",
    "sweep": "use terrain train --search N",
    "find-changes": "use terrain predict --changes DIR",
    "compare": "name several recipes or models in terrain crossval, as --recipe svm,cnn",
    "faults": "use terrain drive --faults NAME,...",
    "track": "use terrain drive --path FILE",
    "odometry": "use terrain calibrate --what odometry",
    "fit-soil": "use terrain calibrate --what soil",
    "measure-slip": "use terrain estimate --filter pose",
}
"""Former command: a sentence that names its successor."""
