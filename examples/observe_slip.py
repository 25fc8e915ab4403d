"""The slip of a tracked robot sample by sample: what a robot's own computer would do with an observer.

    python examples/observe_slip.py
"""

import numpy as np

from terrain.estimation.observers.choice import make_observer
from terrain.estimation.observers.live import LiveObserver
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.tracked.run import Stretch, simulate_tracked
from terrain.simulation.tracked.slope import Slope
from terrain.terramechanics.soil import load_soil

robot = load_robot("orchard_ugv")
ground = [Stretch(load_soil("grass"), 5.0), Stretch(load_soil("dry_sand"))]
speeds = np.full((1500, 2), 0.5)  # m/s of the left and the right track at 50 Hz
run = simulate_tracked(robot, ground, speeds, seed=1, slope=Slope(0.2))

channels = {name: stream.channels for name, stream in run.streams.items()}
observer = LiveObserver(make_observer("tracked", robot), robot, channels)
for sample in replay(run):
    for estimate in observer.step(sample.readings):
        if round(estimate.time_s * 50) % 250 == 0:
            left, right = estimate.slip
            print(
                f"{estimate.time_s:4.0f} s  {sample.terrain:9}  slip {left:.3f} and {right:.3f} "
                f"± {estimate.slip_std[0]:.3f}  {estimate.status.label}"
            )
