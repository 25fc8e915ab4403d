"""Rerun a paper's experiments in simulation, its figures beside the simulated ones.

python examples/papers danzi [--seed N] [--report FILE] [--json FILE] [--quick]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from claims import report_of, reproduce

from pipelines.report import save_report
from terrain.errors import TerrainError
from terrain.files.atomic import atomic_write


def main() -> int:
    """Run the paper that is named."""
    papers = sorted(file.stem for file in Path(__file__).parent.glob("*.yaml"))
    parser = argparse.ArgumentParser(
        prog="python examples/papers", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("paper", choices=papers)
    parser.add_argument("--seed", type=int, default=0, help="of all runs")
    parser.add_argument("--quick", action="store_true", help="few and short runs, to try it out")
    parser.add_argument("--report", type=Path, help="page (.html) or text (.md) to write")
    parser.add_argument("--json", type=Path, help="file of all rows to write")
    given = parser.parse_args()

    def progress(task: str, done: int, total: int) -> None:
        print(f"{task}: {done} of {total} experiments", file=sys.stderr)

    try:
        result = reproduce(given.paper, given.seed, progress, quick=given.quick)
        report = report_of(result)
        if given.report is not None:
            save_report(report, given.report)
        if given.json is not None:
            document = dataclasses.asdict(dataclasses.replace(result, figures=()))
            document.pop("figures")
            atomic_write(given.json, json.dumps(document, indent=2, allow_nan=False) + "\n")
    except TerrainError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
