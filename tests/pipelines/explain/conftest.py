import numpy as np
import pytest

from pipelines.explain.explain import explain
from terrain.robots import load_robot
from terrain.simulation.plants.planar import Ground, spread_numbers
from terrain.simulation.run import simulate

HIDDEN = {"camera_yaw_rad": 0.04}
HUSKY = load_robot("husky")


def simulated(i, robot=HUSKY, effects=HIDDEN, terrain="field"):
    """Return a run that drives and turns, whose camera is turned by 0.04 rad unless other effects are given."""
    time_s = np.arange(1250) / 50
    ahead = 0.5 * np.sin(0.6 * time_s + i) + 0.2 * np.sin(1.9 * time_s)
    twist = np.column_stack([ahead, np.zeros_like(ahead), 0.5 * np.sin(0.9 * time_s + 0.3 * i)])
    twist[:50] *= np.linspace(0, 1, 50)[:, None]
    about = {"run_id": f"{robot.name}_{i}", "terrain": terrain, "effects": effects}
    spreads = {name: spread_numbers(name) for name in ("scatter", "noise")}
    return simulate(robot, twist, Ground(), i, **about, **spreads)


@pytest.fixture(scope="session", autouse=True)
def without_next_drive():
    """No next drive is designed, which takes a fourth of the time of a diagnosis."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("terrain.discrepancy.diagnose.next_drive", lambda *_: None)
        yield


@pytest.fixture(scope="session")
def a_run():
    """Return what simulates a run."""
    return simulated


@pytest.fixture(scope="session")
def few(without_next_drive):
    """Four runs explained by one effect, one of them held out."""
    return explain([simulated(i) for i in range(4)], "husky", effects=["camera_yaw"], hold_out=1, seed=3)
