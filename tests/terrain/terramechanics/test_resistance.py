import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import beta

from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import (
    bekker_pressure,
    compaction_resistance,
    contact_length,
    rigid_wheel_sinkage,
    rolling_resistance,
    slip_sinkage_factor,
)

RADIUS_M, WIDTH_M = 0.2, 0.1


def carried_n(sinkage_m, kc, kphi, n):
    """Vertical force of Bekker's pressure on the front arc of a rigid wheel, integrated over its circle."""
    entry = math.acos(1 - sinkage_m / RADIUS_M)

    def share(angle):
        depth = max(RADIUS_M * (math.cos(angle) - math.cos(entry)), 0.0)
        return WIDTH_M * bekker_pressure(depth, WIDTH_M, kc, kphi, n) * RADIUS_M * math.cos(angle)

    return quad(share, 0.0, entry, epsabs=1e-6, limit=200)[0]


@pytest.mark.parametrize("n", [0.13, 0.5, 0.9, 1.0, 1.3])
@pytest.mark.parametrize("normal_n", [50.0, 300.0])
def test_the_ground_carries_the_wheel_at_its_sinkage(n, normal_n):
    kc, kphi = 5e3, 1.5e6
    modulus = kc + WIDTH_M * kphi
    sinkage_m = rigid_wheel_sinkage(normal_n, RADIUS_M, modulus, n)
    # What the formula leaves out, in closed form: (1 - u^2)^n is not 1 - n u^2, and a circle is no parabola.
    first_order = 0.5 * beta(0.5, n + 1) / (1 - n / 3)
    assert abs(first_order - 1) < 0.09
    carried = carried_n(sinkage_m, kc, kphi, n)
    assert carried / normal_n == pytest.approx(first_order, rel=sinkage_m / (2 * RADIUS_M))


@given(
    n=st.floats(0.1, 2.0),
    factor=st.floats(0.1, 10.0),
    normal_n=st.floats(1.0, 1e4),
    modulus=st.floats(1e3, 1e7),
)
def test_sinkage_is_a_root_of_the_load(n, factor, normal_n, modulus):
    """Load goes with z^(n + 1/2): the root is the (2 n + 1)-th of its square, no factor."""
    once = rigid_wheel_sinkage(normal_n, RADIUS_M, modulus, n)
    again = rigid_wheel_sinkage(normal_n * factor ** (n + 0.5), RADIUS_M, modulus, n)
    assert again == pytest.approx(factor * once, rel=1e-9)


def test_compaction_is_the_work_of_the_pressure():
    for soil in map(load_soil, ("clay", "tilled_loam", "dry_sand")):
        kc, kphi, n = soil.kc_npmn1, soil.kphi_npmn2, soil.sinkage_exponent_ratio
        modulus = kc + WIDTH_M * kphi
        sinkage_m = rigid_wheel_sinkage(300.0, RADIUS_M, modulus, n)
        work = WIDTH_M * quad(bekker_pressure, 0.0, sinkage_m, (WIDTH_M, kc, kphi, n))[0]
        assert compaction_resistance(sinkage_m, modulus, n) == pytest.approx(work, rel=1e-6)


def test_slip_sinks_the_wheel_unless_it_is_absent():
    slips = np.linspace(-1.0, 1.0, 41)
    factors = np.array([slip_sinkage_factor(slip, 1.5) for slip in slips])
    np.testing.assert_allclose(factors, ((1 + np.abs(slips)) / (1 - 0.5 * np.abs(slips))) ** 1.5)
    assert (np.diff(factors[20:]) > 0).all()
    assert {slip_sinkage_factor(slip, 0.0) for slip in slips} == {1.0}
    assert slip_sinkage_factor(7.0, 1.0) == 4.0  # beyond full slip nothing grows


def test_the_arc_takes_over_from_the_tyre_and_ends_at_the_axle():
    depths = np.linspace(0.0, 0.3, 61)
    lengths = np.array([contact_length(z, RADIUS_M, 0.12) for z in depths])
    assert (np.diff(lengths) >= 0).all()
    assert lengths[0] == 0.12
    # chord of the arc: from the lowest point of the wheel to where it enters
    arc = lengths[(lengths > 0.12) & (depths < RADIUS_M)]
    chord = np.sqrt(2 * RADIUS_M * depths[(lengths > 0.12) & (depths < RADIUS_M)])
    np.testing.assert_allclose(2 * RADIUS_M * np.sin(arc / RADIUS_M / 2), chord)
    assert lengths[-1] == pytest.approx(RADIUS_M * math.pi / 2)
    assert rolling_resistance(300.0, 0.05) == 15.0
    assert rolling_resistance(-300.0, 0.05) == 0.0
