"""A robot's program against the live service: send samples as they come, act on the newest step.

Start ``terrain serve --model MODEL`` first, then ``python examples/live_robot.py RUN_FOLDER ws://127.0.0.1:8765``;
the run stands for the robot's sensors.
"""

import sys
import time

from pipelines.serve.client import TerrainClient
from terrain.logs.replay import SENSORS, replay
from terrain.logs.run_folders import read_run


def drive(folder: str, url: str, speed: float = 1.0) -> str:
    """Send a run at its own speed, or so many times as fast; return the terrain at its end."""
    run = read_run(folder)
    channels = {name: run.streams[name].channels for name in SENSORS if name in run.streams}
    terrain = ""
    with TerrainClient(url, run.run_id, run.robot, channels, rate_hz=20.0) as client:
        begin_s, first_s = time.monotonic(), run.start_s
        for sample in replay(run):
            due_s = begin_s + (sample.time_s - first_s) / speed
            time.sleep(max(due_s - time.monotonic(), 0.0))
            readings = sample.readings.items()
            client.send({name: (r.time_s.tolist(), r.values.tolist()) for name, r in readings})
            step = client.latest()  # None where the last one is too old
            if step is not None and step["observation"]["terrain"] not in (None, terrain):
                terrain = step["observation"]["terrain"]
                print(f"{sample.time_s:7.1f} s  {terrain}  {step['observation']['target_slip']['traction']}")
    return terrain


if __name__ == "__main__":
    drive(*sys.argv[1:3])
