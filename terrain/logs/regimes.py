"""How a run was driven: what it was commanded, or how its wheels turned."""

from __future__ import annotations

import numpy as np

from terrain.records import RunLog


def regime_of(run: RunLog) -> str:
    """Return in words how a run was driven: its command where it has one alone, else its mean wheel speeds.

    As ``speed_x_mps 0.1, yaw_rate_radps 0``.
    """
    for name, prefix, decimals in (("commands", "", 3), ("wheels", "speed_", 1)):
        if (stream := run.streams.get(name)) is None:
            continue
        chosen = [i for i, channel in enumerate(stream.channels) if channel.startswith(prefix)]
        values = stream.values[:, chosen]
        if not chosen or not np.isfinite(values).any(axis=0).all():
            continue
        if name == "wheels" or np.nanmax(np.ptp(values, axis=0)) <= 10.0**-decimals:
            means = [round(float(mean), decimals) + 0.0 for mean in np.nanmean(values, axis=0)]
            return ", ".join(f"{stream.channels[i]} {mean:g}" for i, mean in zip(chosen, means, strict=True))
    return run.run_id


def driven_at(run: RunLog, low_mps: float, high_mps: float) -> bool:
    """Return whether a run's mean commanded speed, or without one that of its wheels, is within bounds."""
    commands, wheels = run.streams.get("commands"), run.streams.get("wheels")
    if commands is not None and "speed_x_mps" in commands.channels:
        parts = [name for name in ("speed_x_mps", "speed_y_mps") if name in commands.channels]
        speed = np.linalg.norm(commands.columns(parts), axis=1)
    else:
        names = [] if wheels is None else [name for name in wheels.channels if name.startswith("speed_")]
        if wheels is None or not names:
            return False
        speed = np.abs(wheels.columns(names)).mean(axis=1)
    known = speed[np.isfinite(speed)]
    return bool(known.size and low_mps <= known.mean() <= high_mps)
