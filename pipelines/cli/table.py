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


_GROUPS = {
    "Data": {
        "data.convert": "logs of any layout <-> run folders, MCAP, ROS bags, CSV",
        "cli.inspect": "rates, gaps, clocks, units, signs; the card of a model",
        "data.simulate": "runs of a described robot",
        "learn.label": "set, propose, answer",
    },
    "State": {
        "slip.estimate": "motion and slip, by a filter, an observer or a pose from outside",
        "slip.calibrate": "a robot, an odometry or a soil from logs",
    },
    "Terrain": {
        "learn.crossval": "recipes or models on runs and sessions held out, side by side",
        "learn.train": "evaluate, fit, track, register",
        "learn.predict": "terrain or unknown, target slip",
    },
    "Slip": {"slip.learn_slip": "slip curves and target slips"},
    "Reality": {"explain.explain": "what the simulation gets wrong, and the extended robot"},
    "Control": {"drive.drive": "controllers in closed loop, side by side; --faults, --path"},
    "Live": {
        "serve.serve": "WebSocket, --can BUS, --replay LOG",
        "cli.quickstart": "all of it, on your runs or simulated ones",
    },
}
"""By group and module, the line of help; a command has the name of its module."""

COMMANDS = tuple(
    Command(group, module.rpartition(".")[2].replace("_", "-"), f"pipelines.{module}", text)
    for group, commands in _GROUPS.items()
    for module, text in commands.items()
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
