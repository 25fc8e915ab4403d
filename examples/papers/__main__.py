"""Rerun a paper's experiments in simulation, its figures beside the simulated ones.

python examples/papers danzi [--seed N] [--report FILE] [--json FILE] [--details] [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from claims import report_of, reproduce

from pipelines.report.terminal import terminal_text
from terrain.errors import TerrainError
from terrain.files.atomic import atomic_write
from terrain.files.documents import read_yaml


def main() -> int:
    """Run the paper that is named."""
    papers = sorted(file.stem for file in Path(__file__).parent.glob("*.yaml"))
    parser = argparse.ArgumentParser(
        prog="python examples/papers", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("paper", nargs="?", choices=papers)
    parser.add_argument("--seed", type=int, default=0, help="of all runs")
    parser.add_argument("--quick", action="store_true", help="few and short runs, to try it out")
    parser.add_argument("--details", action="store_true", help="print every row and its reason, too")
    parser.add_argument("--report", type=Path, help="page (.html) or text (.md) to write")
    parser.add_argument("--json", type=Path, help="file of all rows to write")
    given = parser.parse_args()
    if given.paper is None:
        for name in papers:
            described = read_yaml(Path(__file__).parent / f"{name}.yaml")
            print(f"{name:<10}{described['title']}: {len(described['experiments'])} experiments")
        return 0

    def progress(task: str, done: int, total: int) -> None:
        print(f"{task}: {done} of {total} experiments", file=sys.stderr)

    try:
        result = reproduce(given.paper, given.seed, progress, quick=given.quick)
        report = report_of(result)
        if given.report is not None:
            report.save(given.report)
        if given.json is not None:
            document = dataclasses.asdict(dataclasses.replace(result, figures=()))
            document.pop("figures")
            atomic_write(given.json, json.dumps(document, indent=2, allow_nan=False) + "\n")
    except TerrainError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(terminal_text(report, details=given.details))
    return 0


if __name__ == "__main__":
    sys.exit(main())
