"""Whatever arrives at the pilot: no exception, no command that is not finite."""

import numpy as np
import pytest

from pipelines.live.pilot import LivePilot
from terrain.control.pilot_settings import CONTROLLERS, PilotSettings, PilotStatus
from terrain.logs.replay import replay
from terrain.records import Reading, Sample
from terrain.robots import load_robot

WIDTH = {"wheels": 6, "steering": 3, "imu": 9, "odometry": 14}


class Hostile:
    """An object that fails wherever it is touched."""

    def __array__(self, *args, **kwargs):
        raise RuntimeError("not an array")

    def __float__(self):
        raise RuntimeError("not a number")

    def __len__(self):
        raise RuntimeError("no length")


def odd_value(rng, width):
    """One of many things that are no values (k, width), or are."""
    k = int(rng.integers(0, 4))
    things = (
        rng.standard_normal((k, width)),
        rng.standard_normal((k, width + int(rng.integers(1, 3)))),
        10.0 ** rng.uniform(-300, 300, (k, width)),
        np.full((k, width), rng.choice([np.nan, np.inf, -np.inf])),
        rng.integers(-9, 9, (k, width)),
        *(np.zeros((k, width, 2)), np.zeros(width), np.zeros((k, width), complex), np.full((k, width), None)),
        *([["much"] * width] * k, [[0.0], [0.0, 1.0]], None, 10**400, Hostile(), "wheels", {"a": 1}),
    )
    return things[int(rng.integers(len(things)))]


def odd_stamp(rng, time_s):
    """One of many things that are no stamps (k,), or are."""
    k = int(rng.integers(0, 4))
    things = (
        time_s + 0.005 * np.arange(k),
        time_s - rng.uniform(0, 0.5, k),
        time_s + rng.choice([3600.0, -3600.0, 1e300, -1e300]) + 0.005 * np.arange(k),
        np.full(k, rng.choice([np.nan, np.inf, -np.inf])),
        *(np.zeros((k, 1)), ["soon"] * k, None, time_s, [10**400] * k, Hostile()),
    )
    return things[int(rng.integers(len(things)))]


def odd_sample(rng, sample):
    """A sample of which one part or all of it is odd."""
    time_s, twist, readings = sample.time_s, sample.twist, dict(sample.readings)
    for name, width in WIDTH.items():
        if rng.random() < 0.5:
            whole = Reading(odd_stamp(rng, time_s), odd_value(rng, width))
            readings[name] = (whole, odd_value(rng, width), (1, 2, 3))[int(rng.integers(3))]
    if rng.random() < 0.3:
        twist = odd_value(rng, 3)
    if rng.random() < 0.3:
        stamps = odd_stamp(rng, time_s)
        time_s = stamps[0] if isinstance(stamps, np.ndarray) and stamps.size else stamps
    if rng.random() < 0.05:
        readings = odd_value(rng, 3)
    whole = Sample(time_s, twist, readings, "grass" if rng.random() < 0.9 else odd_value(rng, 2))
    return whole if rng.random() < 0.98 else odd_value(rng, 3)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_2500_odd_samples_of_each_controller_neither_raise_nor_command_nonsense(controller, survey):
    rng, sound = np.random.default_rng(7), list(replay(survey))
    settings = PilotSettings(controller=controller, track=controller == "traction")
    pilot = LivePilot(load_robot("agrimaro"), settings=settings)
    with np.errstate(all="ignore"):
        for k in range(2500):
            sample = sound[k % len(sound)]
            command = pilot.step(odd_sample(rng, sample) if rng.random() < 0.7 else sample)
            assert tuple(command.status) == PilotStatus._fields
            for row in (command.wheel_radps, command.steer_rad, command.twist):
                assert row.shape == (3,)
                assert np.isfinite(row).all()
