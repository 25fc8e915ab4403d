"""A race car at up to 30 m/s from one CSV: rolling radius, effective wheelbase, steering offset, understeer.

python examples/unseen/race_car.py [DATA/race_car] [--out race_car]
"""

from pathlib import Path

from second_half import answer, show

from pipelines.data.datasets import load_runs
from terrain.robots import load_robot


def main(data: Path, out: Path | None = None) -> list[str]:
    """Print what the session shows."""
    return show(list(load_runs(data, mapping="race_car")), load_robot("av21"), out)


if __name__ == "__main__":
    answer("race_car", __doc__, main)
