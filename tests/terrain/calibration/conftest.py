"""A robot with a truth that its description does not know, and runs of it on tiles."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.robots import load_robot
from terrain.simulation.dynamic.simulate import simulate
from terrain.simulation.scenario.make import make_scenario
from terrain.terramechanics.soil import load_soil

NOMINAL = load_robot("agrimaro")
HIDDEN = NOMINAL.with_parts(
    steering=replace(NOMINAL.steering, zero_1_rad=0.03, zero_2_rad=-0.02, zero_3_rad=0.015),
    motors=replace(NOMINAL.motors, reduction_ratio=9.4),
    camera=replace(NOMINAL.camera, time_constant_s=0.02, speed_std_mps=0.003),
    sensors=replace(
        NOMINAL.sensors,
        encoder_time_constant_s=0.08,
        gyro_bias_x_radps=0.004,
        gyro_bias_y_radps=-0.003,
        gyro_bias_z_radps=0.006,
        gyro_bias_std_radps=0.0015,
        gyro_std_radps=0.002,
        accel_std_mps2=0.015,
        accel_bias_x_mps2=0.1,
        accel_bias_y_mps2=-0.08,
        accel_bias_z_mps2=0.15,
        accel_scale_x_ratio=1.02,
        accel_scale_y_ratio=0.98,
        accel_scale_z_ratio=1.01,
        current_std_a=0.2,
        steering_std_rad=0.0012,
    ),
)
SOILS = {name: load_soil(name) for name in ("tiles", "grass")}


def drive_hidden(scenario, seed, terrain="tiles", duration_s=None, robot=HIDDEN, **options):
    drive = make_scenario(scenario, robot, terrain, duration_s, seed=seed)
    return simulate(robot, drive, SOILS, seed, run_id=f"{scenario}_{seed:03d}", **options)


@pytest.fixture(scope="session")
def nominal():
    """The description that a calibration starts from."""
    return NOMINAL


@pytest.fixture(scope="session")
def hidden():
    """The robot that was driven."""
    return HIDDEN


@pytest.fixture(scope="session")
def drive():
    """Return a maker of runs of the hidden robot: ``drive(scenario, seed, ...)``."""
    return drive_hidden


@pytest.fixture(scope="session")
def truth():
    """Return a function that tells the hidden truth of a parameter."""

    def of(parameter):
        section, _, name = parameter.partition(".")
        return getattr(getattr(HIDDEN, section), name)

    return of


@pytest.fixture(scope="session")
def coverage(truth):
    """Return a function from calibrations to the share of intervals, by parameter, that hold the truth."""

    def of(calibrations):
        held = {}
        for findings in calibrations:
            for finding in findings:
                if finding.determined and "." in finding.parameter:
                    held.setdefault(finding.parameter, []).append(
                        finding.low <= truth(finding.parameter) <= finding.high
                    )
        return {parameter: float(np.mean(hits)) for parameter, hits in held.items()}

    return of
