"""A simulated robot that drives by the commands of the live service.

Start ``terrain serve --model MODEL --table TABLE --robot ROBOT`` first, then
``python examples/moving_robot.py ROBOT TERRAIN ws://127.0.0.1:8765``; the simulation stands for motors and sensors.
"""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pipelines.serve.client import TerrainClient
from terrain.control.situations import SituationOptions, make_situation, simulate_situation
from terrain.kinematics.commands import wheel_motion
from terrain.kinematics.logged_wheels import sensor_channels
from terrain.records import Command, RunLog, Sample
from terrain.robots import load_robot
from terrain.simulation.assumed import with_assumed

DELAY_S, PERIOD_S = 0.05, 0.02  # from a sample to the wheels; between samples

Controller = Callable[[Sample], Command]


def drive(
    robot_name: str,
    terrain: str,
    url: str,
    scenario: str = "starts",
    *,
    by_twist: bool = False,
    real_time: bool = True,
    seed: int = 0,
    bus: Callable[[Controller], Controller] = lambda controller: controller,
) -> tuple[RunLog, Sequence[dict[str, Any]]]:
    """Return the log of a drive by the served commands, and the answers that were acted on.

    ``by_twist`` follows the command's twist in place of its wheel rates, as motor controllers that know the robot's
    kinematics do; without ``real_time`` each sample waits for its answer, as fast as it goes; ``bus`` is what lies
    between the sensors and the service, such as a fault.
    """
    robot = with_assumed(load_robot(robot_name))
    answers: list[dict[str, Any]] = []
    channels, rate_hz = sensor_channels(robot), 1.0 / PERIOD_S if real_time else 0.0
    with TerrainClient(url, f"{robot.name}-1", robot.name, channels, control=True, rate_hz=rate_hz) as client:
        begin_s = time.monotonic()

        def act(sample: Sample) -> Command:
            if real_time:
                time.sleep(max(begin_s + sample.time_s - time.monotonic(), 0.0))
            streams = {name: (r.time_s.tolist(), r.values.tolist()) for name, r in sample.readings.items()}
            client.send(streams, sample.twist.tolist(), step=not real_time, time_s=sample.time_s)
            answer = client.latest() if real_time else client.step()
            if answer is None:  # none yet, or it is too old
                still = np.zeros(len(robot.wheels))
                return Command(still, still, np.zeros(3), {"status_code": 0.0})
            answers.append(answer)
            wheel_radps, steer_rad, twist = (
                np.array(answer["command"][name]) for name in ("wheel_radps", "steer_rad", "twist")
            )
            if by_twist:
                wheel_radps, steer_rad = wheel_motion(robot, twist[np.newaxis], PERIOD_S, steer_rad)[2:]
                wheel_radps, steer_rad = wheel_radps[0], steer_rad[0]
            return Command(wheel_radps, steer_rad, twist, {"status_code": 1.0})

        made = make_situation(scenario, robot, terrain, seed, SituationOptions())
        return simulate_situation(robot, made, bus(act), DELAY_S), answers


def largest_slip(log: RunLog) -> float:
    """Return the largest true slip of a wheel while the robot moves."""
    truth = log.streams["truth"]
    slip = truth.columns(
        [name for name in truth.channels if name.startswith("slip_") and "angle" not in name]
    )
    return float(np.nanmax(np.abs(slip[np.abs(truth.channel("speed_x_mps")) > 0.1])))


if __name__ == "__main__":
    log, answers = drive(*sys.argv[1:5])
    print(f"{len(answers)} commands driven, slip at most {largest_slip(log):.2f}")
