"""``python tests/studies NAME [options]``: what is measured beside the package, one study a name."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent)]

import click  # noqa: E402

from pipelines.cli.options import OneFile  # noqa: E402
from pipelines.cli.table import Command  # noqa: E402
from terrain.errors import TerrainError  # noqa: E402

STUDIES = {
    "slip": "slip of robots of every drive by what measures their motion, and ten seconds without",
    "consistency": "NEES and coverage of slip by terrain, over simulated runs",
    "long-drives": "yaw of a filter on long drives, and after the loss of the camera",
    "intervals": "coverage of the intervals of all that is identified",
    "adaptation": "what adapting to a session gives, by changes hidden in held-out runs",
    "written-faults": "faults written into measured logs: which are named, and that none is stated that is not there",
    "labels": "what chosen questions and self-training gain, from few labels",
    "foreign": "hide effects in simulators of other equations, and in MuJoCo, explain them, count",
    "trials": "hide effects in simulated runs, diagnose them blindly, count what is right",
    "watching": "false alarms of serve --watch on measured runs held out, and changes written into them",
    "ablation": "what each signal set is worth to the classifier, on all labelled sets",
    "live": "latency of the live chain by stage, and of the service with many robots",
    "soak": "the service for minutes or hours under robots that misbehave at random",
    "scale": "features of ever more runs with ever more processes: time and memory",
    "figures": "the tables of measured figures, from their records",
    "mutants": "faults put in on purpose: whether the tests notice them",
}
"""A line of help by name, which is that of the module: it has ``EXAMPLE``, ``Settings``, ``run`` and ``report``."""


def main(words: list[str]) -> int:
    """Run a study; list them without a name.  Exit code 2 for a mistake, 1 where something is not accepted."""
    if not words or words[0] in ("-h", "--help"):
        print("python tests/studies NAME [options]\n")
        for name, text in STUDIES.items():
            print(f"  {name:<15}{text}")
        return 0
    try:
        if words[0] not in STUDIES:
            raise click.UsageError(f"there is no study {words[0]!r}; there are {', '.join(STUDIES)}")
        module = f"studies.{words[0].replace('-', '_')}"
        command = OneFile(Command("", words[0], module, STUDIES[words[0]]))
        prog_name = f"python tests/studies {words[0]}"
        options: dict[str, Any] = {"standalone_mode": False, "help_option_names": ["-h", "--help"]}
        result: Any = command.main(words[1:], prog_name, **options)
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except (TerrainError, click.ClickException) as error:
        text = error.format_message() if isinstance(error, click.ClickException) else str(error)
        print(f"error: {text}", file=sys.stderr)
        return 2
    return int(bool(getattr(result, "refused", "")))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
