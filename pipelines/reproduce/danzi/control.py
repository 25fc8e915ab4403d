"""Chapter 8 of Danzi, AgriMaRo thesis: what its traction controller does in the cases of table 8.1.

The cases have a wheel of 1 m and a proportional gain of 1; the speed over ground is held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.reproduce.results import Finding, Row, Verdict, holds
from terrain.control.danzi_pid import new_state, thesis_settings, thesis_step
from terrain.control.pid import Gains
from terrain.records import Array

TARGETS = (0.1, -0.15, 0.0)
"""Of table 8.1; it has no steady case."""
ACCEL_MPS2 = 1.0
"""With the motion or against it: table 8.1 has but the sign."""
N_STEPS = 1000
"""How long "for ever" is looked at."""
N_EARLY = 20
"""After that many steps halving leaves a millionth, and rounding begins to show."""
GAIN = 0.5
"""Of the normalised form."""


class Case(NamedTuple):
    """A row of table 8.1: speed over ground and wheel speed, then what is printed of the control."""

    name: str
    braking: bool
    speed_mps: float
    wheel_speed_mps: float
    slip: float
    desired: float
    error: float
    sent_radps: float


CASES = (
    Case("1A, forward, traction", False, 0.6, 0.7, 0.143, 0.1, -0.043, 0.657),
    Case("1B, forward, traction", False, 0.6, 0.63, 0.048, 0.1, 0.052, 0.682),
    Case("1C, forward, braking", True, 0.5, 0.47, -0.060, -0.15, -0.090, 0.380),
    Case("1D, forward, braking", True, 0.5, 0.39, -0.220, -0.15, 0.070, 0.460),
    Case("2A, backward, traction", False, -0.6, -0.7, -0.143, -0.1, 0.043, -0.657),
    Case("2B, backward, traction", False, -0.6, -0.63, -0.048, -0.1, -0.052, -0.682),
    Case("2C, backward, braking", True, -0.5, -0.47, 0.060, 0.15, 0.090, -0.380),
    Case("2D, backward, braking", True, -0.5, -0.39, 0.220, 0.15, -0.070, -0.460),
)


def traction_control(seed: int, quick: bool) -> Finding:
    """8.3.2: one step of the controller in eight cases, and the same steps one after the other."""
    rows = []
    for case in CASES:
        error, sent = _iterated(case, "printed", 1.0, 1)
        desired = float(np.sign(case.speed_mps)) * TARGETS[int(case.braking)]
        slip = desired - float(error[0])
        ours = (slip, desired, error[0], sent[0])
        same = all(f"{a:.3f}" == f"{b:.3f}" for a, b in zip(ours, case[4:], strict=True))
        rows.append(
            Row(
                what=f"Rate sent to the wheel, case {case.name}",
                where="table 8.1",
                printed=f"{case.sent_radps:+.3f} rad/s",
                printed_interval=(case.sent_radps, case.sent_radps),
                simulated=float(sent[0]),
                unit="rad/s",
                verdict=holds(same),
                why="Slip, desired slip, error and rate are compared to the three digits printed.",
                beside={"slip": slip, "desired": desired, "error": float(error[0])},
            )
        )
    return Finding(rows + _iterated_rows())


def _iterated_rows() -> list[Row]:
    swinging, steps = [], {}
    for case in CASES:
        if case.braking:
            error, _ = _iterated(case, "printed", 1.0, N_STEPS)
            swinging.append(abs(error[-1] / error[0]))
        error, _ = _iterated(case, "normalised", GAIN, N_EARLY)
        steps[case.name] = error[1:] / error[:-1]
    left = float(np.mean(swinging))
    braking, traction = (
        np.concatenate([steps[case.name] for case in CASES if case.braking is kind]) for kind in (True, False)
    )
    ours = np.concatenate([braking, traction])
    return [
        Row(
            what=f"Share of the slip error that is left after {N_STEPS} steps of the four braking cases",
            where="(8.3), table 8.1",
            printed="converges to the target",
            simulated=left,
            spread=(float(min(swinging)), float(max(swinging))),
            unit="ratio",
            verdict=Verdict.CORRECTED if left > 0.99 else Verdict.AS_PRINTED,
            why="A slip error, a ratio, is added as rad/s. At 0.5 m/s and a radius of 1 m that changes the "
            "slip by twice the error: it changes its sign in each step, for ever. The next row has the right "
            "form.",
        ),
        Row(
            what=f"Share of the error that a step leaves in all eight cases, normalised, gain {GAIN:g}",
            where="(8.3), table 8.1",
            printed="the output is added as it is",
            simulated=float(ours.mean()),
            spread=(float(ours.min()), float(ours.max())),
            unit="ratio",
            verdict=Verdict.CORRECTED if ours.max() < 0.6 else Verdict.DIFFERS,
            why="K e max(|ω r|, |v|)/r is a rate, and does the same at any speed and radius.",
            beside={"braking": float(braking.max()), "traction, most": float(traction.max())},
        ),
    ]


def _iterated(case: Case, form: str, gain: float, n_steps: int) -> tuple[Array, Array]:
    """Return error and rate sent (n,) of steps whose rate is what the step before sent."""
    settings = thesis_settings(1.0, Gains(gain, 0.0, 0.0, limit=10.0), form)
    state, speed = new_state(1), np.array([case.speed_mps])
    accel = np.copysign(ACCEL_MPS2, -speed if case.braking else speed)
    rate, errors, sent = np.array([case.wheel_speed_mps]), [], []
    for _ in range(n_steps):
        slip = (rate - speed) / np.maximum(np.abs(rate), np.abs(speed))
        added, desired, _, _, state = thesis_step(
            settings, state, rate, rate, speed, accel, abs(case.speed_mps), np.array(TARGETS), 0.02
        )
        rate = rate + added
        errors.append(float(desired[0] - slip[0]))
        sent.append(float(rate[0]))
    return np.array(errors), np.array(sent)
