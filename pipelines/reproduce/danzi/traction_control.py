"""Section 8.3.2 of Danzi, AgriMaRo thesis: its traction controller in the cases of table 8.1.

The cases have a wheel radius of 1 m and a proportional gain of 1; the speed over ground is constant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipelines.reproduce.over_runs import over_runs
from pipelines.reproduce.results import Finding, Row, Verdict, holds
from terrain.control.danzi_pid import new_state, thesis_settings, thesis_step
from terrain.control.pid import Gains
from terrain.records import Array

TARGETS = (0.1, -0.15, 0.0)
"""Slip targets of table 8.1: traction, braking, steady (no case of the table)."""
ACCEL_MPS2 = 1.0
"""In the direction of motion or against it; table 8.1 gives only the sign."""
N_STEPS = 1000
"""Number of steps after which an undamped oscillation is measured."""
N_EARLY = 20
"""Number of steps after which repeated halving leaves 1e-6 of the error; beyond it rounding is visible."""
GAIN = 0.5
"""Gain of the normalised form."""


class Case(NamedTuple):
    """A row of table 8.1: speed over ground, wheel speed, and the printed outputs of the controller."""

    name: str
    braking: bool
    speed_mps: float
    wheel_speed_mps: float
    slip: float
    desired: float
    error: float
    rate_radps: float

    @property
    def printed(self) -> tuple[float, float, float, float]:
        """Slip, desired slip, error and rate as printed."""
        return self.slip, self.desired, self.error, self.rate_radps


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
    """Apply one step of the controller in the eight cases, and then the same step repeatedly."""
    return Finding([*map(_single_step, CASES), *_repeated_steps()])


def _single_step(case: Case) -> Row:
    errors, rates = _iterate(case, "printed", 1.0, 1)
    error, rate = float(errors[0]), float(rates[0])
    desired = float(np.sign(case.speed_mps)) * TARGETS[int(case.braking)]
    simulated = (desired - error, desired, error, rate)
    agrees = all(f"{a:.3f}" == f"{b:.3f}" for a, b in zip(simulated, case.printed, strict=True))
    return Row(
        what=f"Rate sent to the wheel, case {case.name}",
        where="table 8.1",
        printed=f"{case.rate_radps:+.3f} rad/s",
        printed_interval=(case.rate_radps, case.rate_radps),
        simulated=rate,
        unit="rad/s",
        verdict=holds(agrees),
        why="Slip, desired slip, error and rate are compared to the three digits printed.",
        beside={"slip": desired - error, "desired": desired, "error": error},
    )


def _repeated_steps() -> list[Row]:
    remaining, steps = [], {}
    for case in CASES:
        if case.braking:
            error, _ = _iterate(case, "printed", 1.0, N_STEPS)
            remaining.append(float(abs(error[-1] / error[0])))
        error, _ = _iterate(case, "normalised", GAIN, N_EARLY)
        steps[case.name] = error[1:] / error[:-1]
    oscillation = over_runs(remaining)
    braking, traction = (
        np.concatenate([steps[case.name] for case in CASES if case.braking is kind]) for kind in (True, False)
    )
    contraction = np.concatenate([braking, traction])
    return [
        Row(
            what=f"Fraction of the slip error that remains after {N_STEPS} steps of the four braking cases",
            where="(8.3), table 8.1",
            printed="converges to the target",
            simulated=oscillation.mean,
            spread=oscillation.spread,
            unit="ratio",
            verdict=Verdict.CORRECTED if oscillation.mean > 0.99 else Verdict.AS_PRINTED,
            why="A slip error, a ratio, is added as rad/s. At 0.5 m/s and a radius of 1 m that changes the "
            "slip by twice the error: its sign alternates, and it does not decay. The next row has the right "
            "form.",
        ),
        Row(
            what=f"Fraction of the error that remains after a step in all cases, normalised, gain {GAIN:g}",
            where="(8.3), table 8.1",
            printed="the output is added without a conversion",
            simulated=float(contraction.mean()),
            spread=(float(contraction.min()), float(contraction.max())),
            unit="ratio",
            verdict=Verdict.CORRECTED if contraction.max() < 0.6 else Verdict.DIFFERS,
            why="K e max(|ω r|, |v|)/r is a rate, and has the same effect at any speed and radius.",
            beside={"braking": float(braking.max()), "traction, largest": float(traction.max())},
        ),
    ]


def _iterate(case: Case, form: str, gain: float, n_steps: int) -> tuple[Array, Array]:
    """Return slip error and commanded rate (n,) of steps, each from the rate of the previous one."""
    settings = thesis_settings(1.0, Gains(gain, 0.0, 0.0, limit=10.0), form)
    state, speed = new_state(1), np.array([case.speed_mps])
    accel = np.copysign(ACCEL_MPS2, -speed if case.braking else speed)
    rate, errors, rates = np.array([case.wheel_speed_mps]), [], []
    for _ in range(n_steps):
        slip = (rate - speed) / np.maximum(np.abs(rate), np.abs(speed))
        added, desired, _, _, state = thesis_step(
            settings, state, rate, rate, speed, accel, abs(case.speed_mps), np.array(TARGETS), 0.02
        )
        rate = rate + added
        errors.append(float(desired[0] - slip[0]))
        rates.append(float(rate[0]))
    return np.array(errors), np.array(rates)
