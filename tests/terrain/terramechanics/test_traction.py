import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from terrain.robots import load_robot
from terrain.terramechanics.soil import load_soil, scattered, soil_names
from terrain.terramechanics.traction import (
    equilibrium_slip,
    friction_limit,
    ground_record,
    janosi_force,
    mobilised_ratio,
    net_pull,
    wheel_ground,
)

ROBOT = load_robot("agrimaro")
GEOMETRY = (ROBOT.wheel_radius_m, ROBOT.body.tyre_width_m, ROBOT.body.contact_length_m)
NORMAL_N = ROBOT.mass_kg * 9.80665 / 3
START_N = ROBOT.mass_kg / 3 * 1.0
"""What each wheel has to pull beside its resistance in the thesis' start at 1 m/s^2."""

SOILS = {name: load_soil(name) for name in soil_names()}
slips = st.floats(-1.0, 1.0)
names = st.sampled_from(list(SOILS))


def plain(soil, normal_n, slip_x, slip_y):
    """The laws written once more in plain numpy, without series, limits of range or compiled code."""
    radius, width, tyre = GEOMETRY
    if normal_n <= 0:
        return np.zeros(4)
    sinkage, compaction = 0.0, 0.0
    if np.isfinite(soil.kphi_npmn2):
        n, k = soil.sinkage_exponent_ratio, soil.kc_npmn1 + width * soil.kphi_npmn2
        sinkage = (3 * normal_n / ((3 - n) * k * np.sqrt(2 * radius))) ** (2 / (2 * n + 1))
        sinkage *= ((1 + abs(slip_x)) / (1 - abs(slip_x) / 2)) ** soil.slip_sinkage_ratio
        sinkage = min(sinkage, radius)
        compaction = k * sinkage ** (n + 1) / (n + 1)
    resistance = soil.rolling_resistance_ratio * normal_n + compaction
    slip = np.hypot(slip_x, slip_y)
    if slip == 0:
        return np.array([0.0, 0.0, resistance, sinkage])
    if soil.law == "magic":
        b, c, d, e = soil.stiffness_ratio, soil.shape_ratio, soil.peak_friction_ratio, soil.curvature_ratio
        force = normal_n * d * np.sin(c * np.arctan(b * slip - e * (b * slip - np.arctan(b * slip))))
    else:
        length = max(tyre, radius * np.arccos(1 - sinkage / radius))
        limit = soil.cohesion_pa * width * length + normal_n * np.tan(soil.friction_angle_rad)
        x = np.longdouble(slip) * length / soil.shear_modulus_m
        force = float(limit * (1 + np.expm1(-x) / x)) if x > 1e-9 else limit * float(x) / 2
    return np.array([force * slip_x / slip, force * slip_y / slip, resistance, sinkage])


@given(x=st.floats(0.0, 200.0))
@example(x=0.00999)
@example(x=0.01001)
def test_mobilised_share_is_the_mean_of_the_shear_along_the_contact(x):
    mean, _ = quad(lambda u: -math.expm1(-x * u), 0.0, 1.0, points=[min(1.0, 5 / (1 + x))])
    assert mobilised_ratio(x) == pytest.approx(mean, rel=1e-8, abs=1e-15)


@given(
    slip=st.floats(1e-6, 1.0),
    more=st.floats(1e-3, 0.5),
    limit_n=st.floats(1.0, 1e4),
    length_m=st.floats(0.05, 0.5),
    k_m=st.floats(0.002, 0.1),
)
def test_laws_of_ground_that_shears(slip, more, limit_n, length_m, k_m):
    force_n = janosi_force(slip, limit_n, length_m, k_m)
    assert janosi_force(-slip, limit_n, length_m, k_m) == -force_n
    assert 0 < force_n < janosi_force(slip + more, limit_n, length_m, k_m) < limit_n
    assert janosi_force(1e9, limit_n, length_m, k_m) == pytest.approx(limit_n, rel=1e-6)
    # the corrected curve starts at 0 with Fmax l / (2 K)
    tiny = 1e-9
    assert janosi_force(tiny, limit_n, length_m, k_m) / tiny == pytest.approx(
        limit_n * length_m / (2 * k_m), rel=1e-6
    )
    assert janosi_force(0.0, limit_n, length_m, k_m) == 0


@settings(max_examples=120)
@given(
    name=names,
    normal_n=st.floats(-50.0, 1500.0),
    slip_x=slips,
    slip_y=st.floats(-3.0, 3.0),
    slip_sinkage=st.sampled_from([0.0, 0.5, 1.0]),
)
@example(name="dry_sand", normal_n=0.0, slip_x=0.0, slip_y=0.0, slip_sinkage=0.0)
@example(name="clay", normal_n=300.0, slip_x=0.0, slip_y=0.0, slip_sinkage=1.0)
@example(name="snow", normal_n=300.0, slip_x=-1.0, slip_y=3.0, slip_sinkage=0.0)
def test_the_compiled_wheel_is_the_plain_one_and_stays_on_the_friction_circle(
    name, normal_n, slip_x, slip_y, slip_sinkage
):
    soil = replace(SOILS[name], slip_sinkage_ratio=slip_sinkage)
    ground = ground_record(soil, *GEOMETRY)[0]
    found = wheel_ground(ground, normal_n, slip_x, slip_y)
    np.testing.assert_allclose(found, plain(soil, normal_n, slip_x, slip_y), rtol=1e-9, atol=1e-9)
    thrust_n, side_n, resistance_n, sinkage_m = found
    assert thrust_n * slip_x >= 0
    assert side_n * slip_y >= 0
    assert resistance_n >= 0
    assert 0 <= sinkage_m <= GEOMETRY[0]
    if normal_n > 0:
        contact_m = max(GEOMETRY[2], GEOMETRY[0] * math.acos(1 - sinkage_m / GEOMETRY[0]))
        limit_n = (
            normal_n * soil.peak_friction_ratio
            if soil.law == "magic"
            else friction_limit(
                normal_n, GEOMETRY[1] * contact_m, soil.cohesion_pa, math.tan(soil.friction_angle_rad)
            )
        )
        assert math.hypot(thrust_n, side_n) <= limit_n * (1 + 1e-12)
    else:
        assert found == (0.0, 0.0, 0.0, 0.0)


@settings(max_examples=40)
@given(
    name=names,
    normal_n=st.floats(-1e9, 1e9),
    slip_x=st.floats(-1e200, 1e200),
    slip_y=st.floats(-1e200, 1e200),
    slip_sinkage=st.floats(0.0, 5.0),
)
@example(name="dry_sand", normal_n=5e-324, slip_x=5e-324, slip_y=-5e-324, slip_sinkage=5.0)
def test_finite_inputs_give_finite_forces(name, normal_n, slip_x, slip_y, slip_sinkage):
    soil = replace(SOILS[name], slip_sinkage_ratio=slip_sinkage)
    assert np.isfinite(wheel_ground(ground_record(soil, *GEOMETRY)[0], normal_n, slip_x, slip_y)).all()


def test_steady_slip_on_level_ground_and_the_peaks_of_a_start():
    """Of thesis 7.2.3 are those of grass and gravel: steady, and 0.339 and 0.475 at the start."""
    ranges = {"tiles": (0.0, 0.005), "asphalt": (0.0, 0.005), "snow": (0.01, 0.02), "clay": (0.05, 0.1)}
    ranges |= {"grass": (0.116, 0.135), "firm_soil_gravel": (0.122, 0.146)}
    ranges |= {"tilled_loam": (0.13, 0.2), "dry_sand": (0.15, 0.25)}
    assert set(ranges) == set(soil_names())
    rng = np.random.default_rng(0)
    for name, (low, high) in ranges.items():
        soil = SOILS[name]
        slip = equilibrium_slip(soil, NORMAL_N, 0.0, *GEOMETRY)
        assert low < slip < high
        assert net_pull(soil, NORMAL_N, np.array([slip]), *GEOMETRY)[0] == pytest.approx(0.0, abs=1e-6)
        steady = [equilibrium_slip(scattered(soil, rng), NORMAL_N, 0.0, *GEOMETRY) for _ in range(15)]
        assert np.isfinite(steady).all()  # no run is stuck on level ground
        assert max(steady) < 0.5
    starts = [equilibrium_slip(SOILS[n], NORMAL_N, START_N, *GEOMETRY) for n in ("grass", "firm_soil_gravel")]
    assert starts == pytest.approx([0.339, 0.475], abs=0.03)
    assert equilibrium_slip(SOILS["tiles"], NORMAL_N, START_N, *GEOMETRY) < starts[0]


@pytest.mark.parametrize("name", soil_names())
def test_equilibrium_is_the_first_root_of_the_net_pull_on_both_sides(name):
    soil = SOILS[name]
    level_n = net_pull(soil, NORMAL_N, np.array([0.0]), *GEOMETRY)[0]
    best_n = net_pull(soil, NORMAL_N, np.linspace(0, 1, 1001), *GEOMETRY).max()
    for pull_n in (level_n - 20.0, level_n + 20.0, 0.9 * best_n):
        slip = equilibrium_slip(soil, NORMAL_N, pull_n, *GEOMETRY)
        assert (slip > 0) == (pull_n > level_n)
        before = net_pull(soil, NORMAL_N, np.linspace(0, slip, 200)[:-1], *GEOMETRY)
        assert ((before < pull_n) if slip > 0 else (before > pull_n)).all()
    assert equilibrium_slip(soil, NORMAL_N, level_n, *GEOMETRY) == 0.0
    assert math.isnan(equilibrium_slip(soil, NORMAL_N, best_n + 1.0, *GEOMETRY))
    assert math.isnan(equilibrium_slip(soil, NORMAL_N, level_n - 1000.0, *GEOMETRY))
    assert math.isnan(equilibrium_slip(soil, 0.0, 0.0, *GEOMETRY))
