"""Four mecanum wheels from two bags of ROS 1: radius, half lengths, and where motion capture looks from.

python examples/unseen/mecanum.py [DATA/mecanum] [--out mecanum]

Ticks, gear and radius are one number: with the nominal 42 ticks a motor turn and gear 5 the wheels roll on 75 mm, not
70 mm.  The field ``velocity`` of the wheels is published in a unit that no header says; held against the ticks it is
found, and not used.
"""

from pathlib import Path

import numpy as np
from second_half import answer, show

from pipelines.data.bag_runs import read_stream
from pipelines.data.datasets import load_runs
from terrain.logs.mapping import MessageStream
from terrain.robots import load_robot

WHEELS = ("front_left", "front_right", "rear_left", "rear_right")
TICKS_PER_TURN = 42.0  # of a motor, nominal
KNOWN = {"rad/s": 1.0, "deg/s": np.pi / 180.0, "rpm": np.pi / 30.0, "rad/min": 1.0 / 60.0}


def velocity_unit(bag: Path) -> float:
    """Return a unit of the published velocity in rad/s of a motor: turned by the ticks over the velocity's integral."""
    channels = {f"ticks_{name}_rad": {"joint": name, "field": "position", "unit": "rad"} for name in WHEELS}
    channels |= {
        f"rate_{name}_radps": {"joint": name, "field": "velocity", "unit": "rad/s"} for name in WHEELS
    }
    described = MessageStream.model_validate(
        {"topic": "/wheel_states", "kind": "joints", "channels": channels}
    )
    stream = read_stream(bag, "wheels", described, None)
    step_s, ratios = np.diff(stream.time_s)[:, None], []
    ticks, rate = stream.values[:, :4], stream.values[:, 4:]
    integral = np.vstack([np.zeros(4), np.cumsum(step_s * (rate[1:] + rate[:-1]) / 2.0, axis=0)])
    for counted, summed in zip(ticks.T, integral.T, strict=True):
        ratios.append(np.polyfit(summed, counted, 1)[0])
    return float(np.median(ratios)) * 2.0 * np.pi / TICKS_PER_TURN


def main(data: Path, out: Path | None = None) -> list[str]:
    """Print what the bags show."""
    runs = load_runs(data, layout="bag", mapping="omnirobot_topics")
    for bag in sorted(data.rglob("*.bag"))[:1]:
        unit = velocity_unit(bag)
        near = min(KNOWN, key=lambda name: abs(np.log(KNOWN[name] / unit)))
        off, ticks = unit / KNOWN[near] - 1.0, TICKS_PER_TURN * unit / KNOWN[near]
        print(
            f"velocity: a unit is {unit:.5f} rad/s of a motor, {off:+.0%} from {near}, if a turn has "
            f"{TICKS_PER_TURN:g} ticks; it would be {near} with {ticks:.1f} ticks a turn"
        )
    return show(list(runs), load_robot("omnirobot"), out)


if __name__ == "__main__":
    answer("mecanum", __doc__, main)
