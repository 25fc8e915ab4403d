"""The slip of a tracked robot sample by sample, as its own computer would observe it, from grass on to sand.

python examples/observe_slip.py
"""

import numpy as np

from terrain.estimation.live import make_live_filter
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import Slope, Stretch
from terrain.simulation.run import simulate
from terrain.terramechanics.soil import load_soil


def observe(seed: int = 1) -> list[tuple[str, float, float]]:
    """Return terrain, slip of the left track and its standard deviation, every five seconds."""
    robot = load_robot("orchard_ugv")
    ground = [Stretch(load_soil("grass"), 5.0), Stretch(load_soil("dry_sand"))]
    speeds = np.full((1500, 2), 0.5)  # m/s of the left and the right track at 50 Hz
    run = simulate(robot, speeds, ground, seed, slope=Slope(0.2))
    channels = {name: stream.channels for name, stream in run.streams.items()}
    observer, found = make_live_filter("tracked", robot, channels), []
    for sample in replay(run):
        for estimate in observer.step(sample.readings):
            if round(estimate.time_s * 50) % 250 == 0:
                found.append((sample.terrain, estimate.slip[0], estimate.slip_std[0]))
    return found


if __name__ == "__main__":
    for terrain, slip, std in observe():
        print(f"{terrain:9} slip {slip:.3f} ± {std:.3f}")
