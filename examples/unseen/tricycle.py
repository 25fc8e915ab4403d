"""A tricycle from its ticks: steering offset and gain, traction, axle length, and the place of the sensor ahead.

python examples/unseen/tricycle.py [DATA/tricycle] [--out tricycle]

The head of its log states 1.4 m of axle length, a sensor 1.5 m ahead and 0.0106141 m a turn of the encoder, as nominal.
"""

from pathlib import Path

from second_half import answer, show

from pipelines.data.datasets import load_runs
from terrain.robots import load_robot


def main(data: Path, out: Path | None = None) -> list[str]:
    """Print what the log shows."""
    return show(list(load_runs(data)), load_robot("pallet_truck"), out)


if __name__ == "__main__":
    answer("tricycle", __doc__, main)
