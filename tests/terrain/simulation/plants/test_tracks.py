"""Forces under two tracks: shear curve, friction in turning, slopes, and the balance of a steady motion."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.kernels import filled
from terrain.logs.schema import TWIST
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import (
    QUIET,
    STATE,
    PrescribedSlip,
    Slope,
    Stretch,
    _residual,
    drive_tracks,
    slipped_twist,
    tilt_at,
    track_forces,
    tracks_on,
    twist_on_soil,
)
from terrain.simulation.run import simulate
from terrain.terramechanics.soil import load_soil
from terrain.terramechanics.traction import compaction_resistance, mobilised_ratio, plate_sinkage

UGV, PATAKO, SAND = load_robot("orchard_ugv"), load_robot("patako"), load_soil("dry_sand")
FIRM = replace(SAND, rolling_resistance_ratio=0.0, kc_npmn1=math.nan, kphi_npmn2=math.nan)
"""Sand that shears and neither resists nor is pressed."""


def forces(soil, belts, twist, grade=0.0, roll=0.0, heap=0.0):
    out = np.empty(3)
    track_forces(tracks_on(PATAKO, soil)[0], np.array(belts), np.array(twist), grade, roll, heap, out)
    return out


def steady(soil, belts, slope_rad=0.0, uphill_rad=0.0, seconds=1.0, robot=PATAKO):
    """Return the twist once belts have turned for a while from rest."""
    belt_mps = np.tile(np.array(belts, dtype=float), (round(seconds / 0.01), 1))
    states = np.zeros(len(belt_mps), STATE)
    drive_tracks(tracks_on(robot, soil), np.array([slope_rad, uphill_rad]), belt_mps, states, 0.01)
    return np.array([states[-1][name] for name in TWIST])


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
    for _ in range(200):
        twist, out = rng.normal(size=3) * [0.1, 0.1, 0.5], np.empty(3)
        track_forces(tracks, np.zeros(2), twist, 0.0, 0.0, rng.uniform(0, 1e-3), out)
        assert out @ twist < 0.0


@pytest.mark.parametrize("slope_deg", [0.0, 20.0])
def test_a_climb_slips_as_the_balance_of_forces_asks(slope_deg):
    """Two routes: motion in time, and the slip at which the shear curve gives grade and compaction."""
    slope, weight = math.radians(slope_deg), PATAKO.mass_kg * GRAVITY_MPS2
    normal, modulus = 0.5 * weight * math.cos(slope), SAND.kc_npmn1 + 0.15 * SAND.kphi_npmn2
    depth = plate_sinkage(normal / 0.09, 0.15, SAND.kc_npmn1, SAND.kphi_npmn2, 1.1)
    resists = weight * math.sin(slope) + 2 * compaction_resistance(depth, modulus, 1.1) + 0.04 * normal
    limit = 2 * (SAND.cohesion_pa * 0.09 + normal * math.tan(SAND.friction_angle_rad))
    slip = brentq(lambda s: limit * mobilised_ratio(s * 0.6 / SAND.shear_modulus_m) - resists, 0.0, 1.0)
    v_x, v_y, w = steady(SAND, [0.1, 0.1], slope, robot=replace(PATAKO, com_height_m=1e-6))
    assert 1.0 - v_x / 0.1 == pytest.approx(slip, rel=0.02)
    assert abs(v_y) + abs(w) < 1e-9


def test_a_robot_at_rest_stays_on_a_slope():
    assert np.abs(steady(SAND, [0.0, 0.0], math.radians(15.0), 0.7, seconds=5.0)).max() < 1e-4


def test_a_step_from_any_motion_reaches_the_balance():
    """At a kink, where an element starts to slide back, at most 2 mm/s are left for the step after."""
    rng, missing, off = np.random.default_rng(0), np.empty(3), []
    tracks = tracks_on(PATAKO, SAND)[0]
    for k in range(600):
        before = rng.normal(0.0, [0.1, 0.02, 0.2]) if k % 3 else np.zeros(3)
        state = filled(STATE, **dict(zip(TWIST, before, strict=True)))[0]
        belts = rng.choice([-0.2, -0.1, 0.0, 0.1, 0.2, 0.5], 2)
        tilt = tilt_at(math.radians(rng.choice([0, 5, 10, 15])), math.radians(45 * rng.integers(8)), 0.0)
        twist = twist_on_soil(tracks, state, belts, *tilt, 0.01)
        off.append(_residual(tracks, belts, twist, before, (*tilt, 0.0), 0.01, missing))
    assert max(off) < 0.2
    assert np.mean(np.array(off) < 1e-4) > 0.99


def test_in_a_steady_turn_the_ground_gives_the_force_to_the_inside():
    v_x, v_y, w = twist = steady(FIRM, [0.8, 1.6], seconds=4.0)
    along, across, moment = forces(FIRM, [0.8, 1.6], twist)
    mass = PATAKO.mass_kg
    assert [along / mass, across / mass] == pytest.approx([-w * v_y, w * v_x], abs=1e-3)
    assert abs(moment) < 1e-3 * mass
    assert w * v_x > 0.3


def test_bulldozing_resists_turning_and_grows_with_what_is_swept():
    plain = steady(replace(SAND, kphi_npmn2=math.nan, kc_npmn1=math.nan), [0.0, 0.1], seconds=0.3)[2]
    early = steady(SAND, [0.0, 0.1], seconds=0.3)[2]
    late = steady(SAND, [0.0, 0.1], seconds=8.0)[2]
    assert plain > early > late > 0.5 * plain


@pytest.mark.parametrize("power", [0.5, 1.0, 1.5])
@pytest.mark.parametrize("belts", [(0.02, 0.1), (-0.03, 0.1), (0.05, -0.2)])
def test_prescribed_turning_slip_is_endos_law_and_continuous_where_a_track_stops(power, belts):
    left, right = belts
    slip = PrescribedSlip(turning_loss_ratio=0.3, turning_exponent=power)
    tracks = tracks_on(replace(PATAKO, track_m=0.4), slip)[0]
    v_x, _, w = slipped_twist(tracks, *belts, 0.0, 0.0)
    slip_left, slip_right = 1 - (v_x - 0.2 * w) / left, 1 - (v_x + 0.2 * w) / right
    assert slip_left / slip_right == pytest.approx(-np.sign(left * right) * abs(right / left) ** power)
    assert w == pytest.approx(0.7 * (right - left) / 0.4)
    at = np.array(slipped_twist(tracks, 0.0, right, 0.0, 0.0))
    assert slipped_twist(tracks, 1e-12, right, 0.0, 0.0) == pytest.approx(at, abs=2e-6)


def test_soil_changes_where_a_stretch_ends_and_labels_say_so():
    ground = [Stretch(load_soil("tilled_loam"), 2.0), Stretch(SAND)]
    run = simulate(UGV, np.full((1001, 2), 0.3), ground, 0, slope=Slope(0.2), sensors=QUIET)
    assert [label.terrain for label in run.labels] == ["tilled_loam", "dry_sand"]
    truth = run.streams["truth"]
    slip, at = truth.channel("slip_left_ratio"), round(run.labels[0].end_s * 100)
    assert abs(truth.channel("position_x_m")[at] - 2.0) < 0.01
    assert abs(slip[at + 100 :].mean() - slip[100 : at - 50].mean()) > 0.002


def test_what_cannot_be_driven_is_refused_in_one_sentence():
    for ground, speeds, message in (
        (load_soil("asphalt"), np.zeros((5, 2)), "soil 'asphalt' has the law 'magic'"),
        (PrescribedSlip(), np.zeros((5, 3)), "track_speed_mps has shape"),
        (PrescribedSlip(), np.full((5, 2), np.nan), "finite numbers"),
        ([], np.zeros((5, 2)), "no stretch is given"),
    ):
        with pytest.raises(ConfigError, match=message):
            simulate(PATAKO, speeds, ground, 0)
