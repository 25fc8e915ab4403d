"""Forces on a tracked robot on a grade: integrals, small slip, reach, and the simulated robot."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import quad

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import QUIET, Slope
from terrain.simulation.run import simulate
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import bekker_pressure, janosi_force, mobilised_ratio

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "papers"))

from tracks import janosi_slip, shear_of_ratio, straight_slip_line, track_balance

ROBOT = load_robot("patako")
SAND = load_soil("toyoura_sand")


@pytest.mark.parametrize("grade", [-0.2, 0.0, 0.1, 0.3])
def test_the_thrust_is_the_integral_of_the_shear_stress(grade):
    found = track_balance(ROBOT, SAND, grade)
    resists = found.compaction_n + found.rolling_n + found.grade_n
    assert found.grade_n == pytest.approx(25 * GRAVITY_MPS2 * math.sin(grade))
    area = 2 * 0.15 * 0.6
    stress = found.limit_n / area
    sheared = quad(lambda x: -stress * math.expm1(-abs(found.slip_ratio) * x / SAND.shear_modulus_m), 0, 0.6)
    assert math.copysign(2 * 0.15 * sheared[0], found.slip_ratio) == pytest.approx(resists, rel=1e-9)
    rut = quad(
        lambda z: bekker_pressure(z, 0.15, SAND.kc_npmn1, SAND.kphi_npmn2, SAND.sinkage_exponent_ratio),
        0,
        found.sinkage_m,
    )
    assert found.compaction_n == pytest.approx(2 * 0.15 * rut[0], rel=1e-6)


def test_small_slip_is_the_line_and_large_slip_lies_above_it():
    intercept, slope = straight_slip_line(ROBOT, SAND)
    for grade in (0.001, 0.02):
        assert track_balance(ROBOT, SAND, grade).slip_ratio == pytest.approx(
            intercept + slope * grade, rel=0.08
        )
    assert track_balance(ROBOT, SAND, 0.4).slip_ratio > 1.3 * (intercept + slope * 0.4)


def test_beyond_reach_there_is_no_slip_and_hard_ground_is_refused():
    assert math.isnan(track_balance(ROBOT, SAND, SAND.friction_angle_rad).slip_ratio)
    with pytest.raises(ConfigError, match="janosi"):
        track_balance(ROBOT, load_soil("asphalt"), 0.0)


def test_it_is_the_slip_of_the_simulated_robot():
    belts = np.full((400, 2), 0.05)
    for grade in (0.0, 0.15, 0.3):
        run = simulate(ROBOT, belts, SAND, 0, slope=Slope(grade), sensors=QUIET)
        slip = 1 - run.streams["truth"].channel("speed_x_mps")[-1] / 0.05
        # the simulated pressure moves to the rear on a grade, where the soil has been sheared further
        assert slip == pytest.approx(track_balance(ROBOT, SAND, grade).slip_ratio, rel=0.2, abs=0.002)


def test_shear_of_ratio_inverts_the_mobilised_ratio():
    """To rounding: the ratio near 1 holds x to eps / (1 - f), which is what x itself allows."""
    shear = np.concatenate([[0.0], np.logspace(-12, 3, 601)])
    found = shear_of_ratio([mobilised_ratio(x) for x in shear])
    np.testing.assert_allclose(found, shear, rtol=2e-13)
    assert np.isnan(shear_of_ratio([-0.1, 1.0, 1.5, np.nan])).all()


def test_slip_of_a_force_inverts_the_force():
    slips = np.array([-1.0, -0.3, -1e-9, 0.0, 1e-9, 0.05, 0.3, 1.0])
    forces = [janosi_force(slip, 2000.0, 1.2, 0.02) for slip in slips]
    np.testing.assert_allclose(janosi_slip(forces, 2000.0, 1.2, 0.02), slips, rtol=1e-12)
    assert np.isnan(janosi_slip([2000.0, -2500.0], 2000.0, 1.2, 0.02)).all()
