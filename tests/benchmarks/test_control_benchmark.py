"""How long a control step takes: ``pytest tests/benchmarks --benchmark-enable``.

Calls of one group correct the same wheels, so that their times can be divided; all of it runs on one core,
and is timed in seconds of that core.
"""

import time

import numpy as np
import pytest

from pipelines.live.pilot import LivePilot
from terrain.control.pid import Gains, WheelPid, wheel_step
from terrain.control.robot_control import PilotSettings
from terrain.control.traction import SETTINGS, TractionState, TractionTarget, WheelMotion, traction_step
from terrain.logs.replay import replay
from terrain.robots import load_robot
from terrain.simulation.run import simulate_run

N_STEPS = 2000
MOST_US = {"traction": 60.0, "thesis": 60.0}  #: Of a step: three thousandths of a period of 20 ms
MOST_PILOT_US = 300.0  #: Of a whole step of the chain: a part in 70 of its period
ROBOT = load_robot("agrimaro")
GAINS = Gains(0.5, 0.5, 2.0)
DT_S = 0.02


def rows():
    """Three wheels in a start: command, rate, ground speed, acceleration, slip, torque (n, 3)."""
    rng = np.random.default_rng(0)
    desired = np.minimum(np.arange(N_STEPS) * 0.1, 5.0)[:, None] * np.ones(3)
    ground = 0.17 * desired + 0.01 * rng.standard_normal((N_STEPS, 3))
    accel = 0.3 * rng.standard_normal((N_STEPS, 3))
    slip = np.clip(1 - ground / np.maximum(0.2 * desired, 0.05), -1, 1)
    return desired, desired, ground, accel, slip, 10 + rng.standard_normal((N_STEPS, 3))


def with_traction(desired, rate, ground, accel, slip, torque):
    state, std, aim = TractionState(), np.full(3, 0.005), TractionTarget(0.1)
    for u, v, a, s, t in zip(desired, ground, accel, slip, torque, strict=True):
        wheels = WheelMotion(v, a, s, std, t, u, 0.0, 0.0)
        command, state, _ = traction_step(SETTINGS, state, aim, 0.2, u, wheels, DT_S)
    return command


def with_thesis(desired, rate, ground, accel, slip, torque):
    states, targets = [WheelPid()] * 3, (0.1, -0.15, 0.05)
    for u, w, v, a in zip(desired, rate, ground, accel, strict=True):
        steps = [
            wheel_step(GAINS, 0.2, state, *row, float(v[0]), targets, DT_S)
            for state, *row in zip(states, u.tolist(), w.tolist(), v.tolist(), a.tolist(), strict=True)
        ]
        states = [state for _, state in steps]
    return u + np.array([wheel.correction_radps for wheel, _ in steps])


@pytest.mark.benchmark(group=f"{N_STEPS} control steps of three wheels", timer=time.process_time)
@pytest.mark.parametrize("drive", [with_traction, with_thesis])
def test_a_control_step(benchmark, drive):
    given = rows()
    assert np.isfinite(benchmark(drive, *given)).all()
    name = drive.__name__.removeprefix("with_")
    if benchmark.stats:  # absent where benchmarks are off
        assert benchmark.stats.stats.min / N_STEPS * 1e6 < MOST_US[name]


@pytest.mark.benchmark(group="the whole chain", timer=time.process_time)
@pytest.mark.parametrize("controller", ["traction", "thesis"])
def test_a_step_of_the_pilot_leaves_the_loop_its_time(benchmark, controller):
    samples = list(replay(simulate_run(ROBOT, "grass", "straight", 0, duration_s=5.0)))

    def new():
        return (LivePilot(ROBOT, settings=PilotSettings(controller=controller)),), {}

    def drive(pilot):
        return [pilot.step(sample) for sample in samples]

    assert len(benchmark.pedantic(drive, setup=new, rounds=5)) == len(samples)
    if benchmark.stats:
        assert benchmark.stats.stats.min / len(samples) * 1e6 < MOST_PILOT_US
