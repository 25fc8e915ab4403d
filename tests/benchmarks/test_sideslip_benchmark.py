"""How long a step of an observer of sideslip takes, with its reading: at most 10 us, beside plain numpy.

``pytest tests/benchmarks/test_sideslip_benchmark.py --benchmark-enable``
"""

import numpy as np
import pytest

from terrain.estimation.observers.sideslip_dynamic import sideslip_dynamic_observer
from terrain.estimation.observers.sideslip_kinematic import sideslip_kinematic_observer
from terrain.estimation.observers.sideslip_multi import sideslip_multi_observer
from terrain.robots import load_robot

ROBOT = load_robot("adap2e")
N_STEPS = 1000
FACTORIES = {
    "kinematic": sideslip_kinematic_observer,
    "dynamic": sideslip_dynamic_observer,
    "multi": sideslip_multi_observer,
}


def rows():
    time_s = np.arange(N_STEPS) * 0.02
    out = np.full((N_STEPS, 8), np.nan)
    out[:, 0], out[:, 1], out[:, 5], out[:, 6], out[:, 7] = 4.0, 0.05, 0.17, 0.0, 0.7
    out[::5, 2], out[::5, 3] = np.sin(0.17 * time_s[::5]) / 0.0425, (1 - np.cos(0.17 * time_s[::5])) / 0.0425
    out[::5, 4] = 0.17 * time_s[::5]
    return out


@pytest.mark.parametrize("name", FACTORIES)
@pytest.mark.benchmark(group="observer of sideslip, 1000 steps with their readings")
def test_step_and_read(benchmark, name):
    observer, data = FACTORIES[name](ROBOT), rows()

    def run():
        memory = np.array(observer.start)
        for row in data:
            memory = observer.step(observer.params, memory, row, 0.02)
            output = observer.read(observer.params, memory)
        return output

    assert np.isfinite(benchmark(run).slip).all()


@pytest.mark.benchmark(group="observer of sideslip, 1000 steps with their readings")
def test_plain_numpy(benchmark):
    """Lines of (8) and (9) alone, without gates, statuses and covariance, in the interpreter."""
    data, base, inertia, mass = rows(), 1.2, 200.0, 420.0

    def run():
        dyn, slip, stiffness = np.zeros(2), np.zeros(2), np.full(2, 15000.0)
        for row in data:
            u, steer, rate = row[0], row[1], row[5]
            by_force = np.array(
                [[-0.6 * np.cos(steer) / inertia, 0.6 / inertia], [-np.cos(steer) / mass, -1 / mass]]
            )
            side = u * (0.6 * np.tan(steer + slip[0]) + 0.6 * np.tan(slip[1])) / base
            dyn = dyn + 0.02 * (by_force @ (stiffness * slip) - np.array([0.0, u * rate]))
            error = np.array([rate, side]) - dyn
            by_slip, by_stiffness = by_force * stiffness, by_force * slip
            kept = np.eye(2) * 1.4 + 4e-4 * (1e-2 * by_slip @ by_slip.T + 1e9 * by_stiffness @ by_stiffness.T)
            error = np.linalg.solve(kept, error)
            dyn, slip = dyn + 0.4 * error, slip + 2e-4 * by_slip.T @ error
            stiffness = stiffness + 2e7 * by_stiffness.T @ error
        return slip

    assert np.isfinite(benchmark(run)).all()
