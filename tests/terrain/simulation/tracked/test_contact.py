"""Forces under two tracks: shear curve, friction in turning, slopes, and the balance of a steady motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from terrain.constants import GRAVITY_MPS2
from terrain.kernels import filled
from terrain.robots import load_robot
from terrain.simulation.tracked import (
    STATE,
    _residual,
    drive,
    tilt_at,
    track_forces,
    track_loads,
    tracks_on,
    twist_on_soil,
)
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import compaction_resistance, mobilised_ratio, plate_sinkage

PATAKO, SAND = load_robot("patako"), load_soil("dry_sand")
FIRM = replace(SAND, rolling_resistance_ratio=0.0, kc_npmn1=math.nan, kphi_npmn2=math.nan)
"""Sand that shears and neither resists nor is pressed."""


def forces(soil, belts, twist, grade=0.0, roll=0.0, heap=0.0):
    out = np.empty(3)
    track_forces(tracks_on(PATAKO, soil)[0], np.array(belts), np.array(twist), grade, roll, heap, out)
    return out


def steady(soil, belts, slope_rad=0.0, uphill_rad=0.0, seconds=1.0, robot=PATAKO):
    """Return the twist once belts have turned for a while from rest."""
    belt_mps = np.tile(np.array(belts, dtype=float), (round(seconds / 0.01), 1))
    return twist_of(driven(belt_mps, soil, [slope_rad, uphill_rad], 0.01, robot)[-1])


def driven(belt_mps, soil, slope, dt_s, robot=PATAKO):
    states = np.zeros(len(belt_mps), STATE)
    drive(tracks_on(robot, soil), np.array(slope), belt_mps, states, dt_s)
    return states


def twist_of(state):
    return np.array([state[name] for name in ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")])


@pytest.mark.parametrize("slip", [0.02, 0.2, 0.8])
def test_straight_traction_is_the_shear_curve(slip):
    limit = 2 * SAND.cohesion_pa * 0.09 + PATAKO.mass_kg * GRAVITY_MPS2 * math.tan(SAND.friction_angle_rad)
    curve = limit * mobilised_ratio(slip * PATAKO.contact_length_m / SAND.shear_modulus_m)
    along, across, moment = forces(FIRM, [0.5, 0.5], [0.5 * (1 - slip), 0.0, 0.0])
    assert along == pytest.approx(curve, rel=0.01)
    assert abs(across) + abs(moment) < 1e-9 * limit


def test_a_track_that_slides_sideways_takes_the_integral_of_its_shear_stress():
    """Two routes: the elements, and an integral of the stress along the contact."""
    drift, belt = 0.02, 0.1
    friction = FIRM.cohesion_pa + PATAKO.mass_kg * GRAVITY_MPS2 / 0.18 * math.tan(FIRM.friction_angle_rad)
    stress = quad(lambda back: friction * -math.expm1(-drift / belt * back / FIRM.shear_modulus_m), 0.0, 0.6)
    assert forces(FIRM, [belt, belt], [belt, drift, 0.0])[1] == pytest.approx(
        -2 * PATAKO.track_width_m * stress[0], rel=0.01
    )


def test_forces_mirror_with_the_turn_and_with_the_direction_of_travel():
    turning = forces(SAND, [0.02, 0.1], [0.05, -0.004, 0.15], roll=0.1, heap=1e-4)
    mirrored = forces(SAND, [0.1, 0.02], [0.05, 0.004, -0.15], roll=-0.1, heap=1e-4)
    assert mirrored == pytest.approx(turning * [1, -1, -1], rel=1e-9)
    backward = forces(SAND, [-0.1, -0.02], [-0.05, 0.004, 0.15], roll=-0.1, heap=1e-4)
    assert backward == pytest.approx(turning * [-1, -1, 1], rel=1e-9)


def test_friction_takes_energy_from_any_motion():
    rng = np.random.default_rng(0)
    tracks = tracks_on(PATAKO, SAND)[0]
    for _ in range(500):
        twist, out = rng.normal(size=3) * [0.1, 0.1, 0.5], np.empty(3)
        track_forces(tracks, np.zeros(2), twist, 0.0, 0.0, rng.uniform(0, 1e-3), out)
        assert out @ twist < 0.0


def test_loads_carry_the_weight_and_balance_the_moment_of_gravity():
    grade, roll = tilt_at(math.radians(15.0), math.radians(50.0), 0.0)
    left, right, ahead = track_loads(tracks_on(PATAKO, SAND)[0], grade, roll)
    weight = PATAKO.mass_kg * GRAVITY_MPS2
    assert left + right == pytest.approx(weight * math.cos(math.radians(15.0)))
    across, along = -weight * math.sin(roll) * math.cos(grade), -weight * math.sin(grade)
    assert (left - right) * PATAKO.half_track_m == pytest.approx(across * PATAKO.com_height_m)
    assert (left + right) * ahead == pytest.approx(along * PATAKO.com_height_m)
    assert right > left > 0.0  # uphill is to the left: the right track carries more


@pytest.mark.parametrize("slope_deg", [0.0, 10.0, 20.0])
def test_a_climb_slips_as_the_balance_of_forces_asks(slope_deg):
    """Two routes: motion in time, and the slip at which the shear curve gives grade and compaction."""
    slope = math.radians(slope_deg)
    weight = PATAKO.mass_kg * GRAVITY_MPS2
    normal, modulus = 0.5 * weight * math.cos(slope), SAND.kc_npmn1 + 0.15 * SAND.kphi_npmn2
    depth = plate_sinkage(normal / 0.09, 0.15, SAND.kc_npmn1, SAND.kphi_npmn2, 1.1)
    resists = weight * math.sin(slope) + 2 * compaction_resistance(depth, modulus, 1.1) + 0.04 * normal
    limit = 2 * (SAND.cohesion_pa * 0.09 + normal * math.tan(SAND.friction_angle_rad))
    slip = brentq(lambda s: limit * mobilised_ratio(s * 0.6 / SAND.shear_modulus_m) - resists, 0.0, 1.0)
    v_x, v_y, w = steady(SAND, [0.1, 0.1], slope, robot=replace(PATAKO, com_height_m=1e-6))
    assert 1.0 - v_x / 0.1 == pytest.approx(slip, rel=0.02)
    assert abs(v_y) + abs(w) < 1e-9


def test_gravity_sets_the_side_slip_of_both_directions():
    up_left = math.pi / 2
    ahead, back = (steady(SAND, [v, v], 0.2, up_left) for v in (0.1, -0.1))
    assert ahead[1] < -1e-4
    assert back[1] < -1e-4
    assert ahead[1] == pytest.approx(back[1], rel=0.05)


def test_a_robot_that_turns_loses_a_part_of_the_difference_of_its_tracks():
    v_x, _, w = steady(SAND, [-0.05, 0.05], seconds=0.3)
    assert abs(v_x) < 1e-4
    assert 0.5 * 0.1 / PATAKO.track_m < w < 0.9 * 0.1 / PATAKO.track_m


def test_a_robot_at_rest_stays_on_a_slope():
    assert np.abs(steady(SAND, [0.0, 0.0], math.radians(15.0), 0.7, seconds=5.0)).max() < 1e-4


def test_a_step_from_any_motion_reaches_the_balance():
    """At a kink, where an element starts to slide back, at most 2 mm/s are left for the step after."""
    rng, missing, off = np.random.default_rng(0), np.empty(3), []
    tracks, names = tracks_on(PATAKO, SAND)[0], ("speed_x_mps", "speed_y_mps", "yaw_rate_radps")
    for k in range(1500):
        before = rng.normal(0.0, [0.1, 0.02, 0.2]) if k % 3 else np.zeros(3)
        state = filled(STATE, **dict(zip(names, before, strict=True)))[0]
        belts = rng.choice([-0.2, -0.1, 0.0, 0.1, 0.2, 0.5], 2)
        tilt = tilt_at(math.radians(rng.choice([0, 5, 10, 15])), math.radians(45 * rng.integers(8)), 0.0)
        twist = twist_on_soil(tracks, state, belts, *tilt, 0.01)
        off.append(_residual(tracks, belts, twist, before, (*tilt, 0.0), 0.01, missing))
    assert max(off) < 0.2
    assert np.mean(np.array(off) < 1e-4) > 0.99


def test_bulldozing_resists_turning_and_grows_with_what_is_swept():
    plain = steady(replace(SAND, kphi_npmn2=math.nan, kc_npmn1=math.nan), [0.0, 0.1], seconds=0.3)[2]
    early = steady(SAND, [0.0, 0.1], seconds=0.3)[2]
    late = steady(SAND, [0.0, 0.1], seconds=8.0)[2]
    assert plain > early > late > 0.5 * plain


def test_any_step_gives_the_same_motion():
    def after(dt):
        belts = np.tile([0.02, 0.12], (round(2.0 / dt) + 1, 1))
        return list(driven(belts, SAND, [0.2, 0.5], dt)[-1])[:5]

    assert after(0.01) == pytest.approx(after(0.0025), abs=1e-3)
