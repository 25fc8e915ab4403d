"""Models of the papers by themselves, against their equations; what they show in experiments is judged in their rows
(``test_papers``)."""

import math
from itertools import pairwise

import numpy as np
import pytest
from multi_model import Gains, MultiModel
from scipy.integrate import quad
from scipy.linalg import expm
from stiffness import StiffnessLevel, cost_matrix, least_cost_class, response_of
from tracked_speed import TrackSpeedSettings, TrackSpeedStatus, track_speed_step
from tracked_stability import disturbance_bound, error_matrix, regressor
from tracks import janosi_slip, shear_of_ratio, track_balance

from terrain.constants import GRAVITY_MPS2
from terrain.errors import ConfigError
from terrain.estimation.models.observer import observe
from terrain.robots import load_robot
from terrain.simulation.plants.tracks import QUIET, Slope
from terrain.simulation.run import simulate
from terrain.terramechanics.soil import load_soil, soil_names
from terrain.terramechanics.traction import bekker_pressure, janosi_force, mobilised_ratio

# -- Stiffness of the ground: costs of confusing its levels, and the order of soils (Danzi)

SOFT, FIRM, HARD = StiffnessLevel


def test_the_decision_of_least_cost_has_the_least_cost_of_all_decisions():
    probability = np.random.default_rng(0).dirichlet([0.5] * 4, size=200)
    cost = cost_matrix([SOFT, FIRM, HARD, HARD])
    chosen = least_cost_class(probability, cost)
    for p, column in zip(probability, chosen, strict=True):
        expected = [sum(p[i] * cost[i, j] for i in range(4)) for j in range(4)]
        assert expected[column] == pytest.approx(min(expected))
    assert np.any(chosen != probability.argmax(axis=1))


def test_harder_levels_are_less_difficult_only_soft_ground_sinks_and_sand_is_the_most_difficult():
    found = {name: response_of(load_soil(name), 294.3, 0.2, 0.1, 0.12) for name in soil_names()}
    order = sorted(found, key=lambda name: found[name].difficulty_ratio)
    assert (order[:2], order[-1]) == (["tiles", "asphalt"], "dry_sand")
    by_level = [
        [each.difficulty_ratio for each in found.values() if each.level is level] for level in StiffnessLevel
    ]
    for softer, harder in pairwise(by_level):
        assert min(softer) > max(harder)
    assert all((each.sinkage_m > 0) == (each.level is SOFT) for each in found.values())


# -- The multi-model observer with the gains of the paper (Deremetz et al.)

ADAP2E = load_robot("adap2e")


def test_on_a_straight_path_it_is_8_and_9():
    """With deviations y, theta~ of the path y = 0, integrated at 1 ms without noise."""
    dt_s, speed, steer, slips = 0.001, 3.0, 0.02, np.array([-0.03, 0.04])
    gains = Gains(4.0, 5e9, 1e-2, excited_mps2=0.0, instrument=False)
    base, arm = ADAP2E.wheelbase_m, ADAP2E.com_ahead_m
    time_s = np.arange(2000) * dt_s
    turning = speed * (np.tan(steer + slips[0]) - np.tan(slips[1])) / base
    yaw, along = turning * time_s, speed / np.cos(slips[1])  # v of the paper: u = v cos b_R is measured
    x, y = (np.cumsum(along * f(yaw + slips[1])) * dt_s for f in (np.cos, np.sin))
    rows = np.full((time_s.size, 8), np.nan)
    rows[:, :2], rows[:, 2], rows[:, 3], rows[:, 4] = (speed, steer), x, y, yaw
    rows[:, 5:7] = turning, 0.0
    track = observe(MultiModel(ADAP2E, gains), time_s, rows)
    dev, slip, paper = np.array([y[0], yaw[0]]), np.zeros(2), np.full((time_s.size, 4), np.nan)
    dyn, stiffness, cos = np.zeros(2), np.full(2, 15000.0), np.cos(steer)
    axles = np.array([[-arm * cos, arm], [-cos, -1.0]]) / [[ADAP2E.yaw_inertia_kgm2], [ADAP2E.mass_kg]]
    for k in range(1, time_s.size):
        v = speed / np.cos(slip[1])
        error = np.array([y[k], yaw[k]]) - dev
        rate = v * np.cos(slip[1]) * (np.tan(steer + slip[0]) - np.tan(slip[1])) / base
        front, rear = speed / base / np.cos(steer + slip[0]) ** 2, speed / base / np.cos(slip[1]) ** 2
        jacobian = np.array([[0.0, v * np.cos(yaw[k] + slip[1])], [front, -rear]])
        dev = dev + dt_s * (np.array([v * np.sin(yaw[k] + slip[1]), rate]) + 15.0 * error)
        beta = np.arctan((arm * np.tan(slip[0] + steer) + arm * np.tan(slip[1])) / base)  # (4)
        virtual = v * np.cos(slip[1]) / np.cos(beta) * np.sin(beta)
        g = axles @ (stiffness * slip) - np.array([0.0, speed * turning])
        e_dyn = np.array([turning, virtual]) - dyn
        dyn = dyn + dt_s * (g + 20.0 * e_dyn)
        change = (
            gains.slip_gain * jacobian.T @ error + gains.dynamic_slip_ratio * (axles * stiffness).T @ e_dyn
        )
        stiffness = stiffness + dt_s * gains.stiffness_gain * (axles * slip).T @ e_dyn
        stiffness, slip = np.clip(stiffness, 1000.0, 30000.0), slip + dt_s * change
        paper[k] = *slip, *stiffness
    assert track.slip[500:] == pytest.approx(paper[500:, :2], abs=0.003)
    assert track.mean[500:, 5:7] == pytest.approx(paper[500:, 2:], rel=0.03)
    assert np.ptp(paper[1:, 2:], axis=0).min() > 1000.0


# -- Compensation of slip: its algebra and limits (Tazzari et al.)

UGV = load_robot("orchard_ugv")
D, DT_S = UGV.half_track_m, 0.02
SETTINGS = TrackSpeedSettings()
ONES, NONE = np.ones(2), np.zeros(2)


def command(eta, std=NONE, forward=0.5, turn=0.1, used=None, dt_s=DT_S, settings=SETTINGS):
    used = np.array(eta if used is None else used)
    return track_speed_step(UGV, settings, used, (forward, turn), np.array(eta), std, dt_s)


def motion(left, right, left_eta, right_eta):
    return (right_eta * right + left_eta * left) / 2, (right_eta * right - left_eta * left) / (2 * D)


@pytest.mark.parametrize("speeds", [(0.5, 0.1), (-0.5, 0.1), (0.0, 0.4), (0.0, 0.0)])
def test_known_efficiencies_give_the_desired_motion(speeds):
    left, right, _, status = command([1.2, 0.7], forward=speeds[0], turn=speeds[1])
    assert motion(left, right, 1.2, 0.7) == pytest.approx(speeds)
    assert status == TrackSpeedStatus.OK


def test_too_fast_a_motion_keeps_its_curvature():
    left, right, _, status = command([0.9, 0.6], forward=2.0, turn=0.8)
    forward, turn = motion(left, right, 0.9, 0.6)
    assert turn / forward == pytest.approx(0.4)
    assert max(left, right) == pytest.approx(TrackSpeedSettings().track_speed_max_mps)
    assert status == TrackSpeedStatus.SATURATED


# -- Excitation and the bound of Remark 1 (Tazzari et al.)

HALF_TRACK_M = 0.5


@pytest.mark.parametrize(
    ("speeds", "gain"),
    [((0.6, 0.6), (2.0, 2.0, 4.0)), ((-0.5, 0.5), (1.0, 1.0, 1.0)), ((0.1, 0.6), (2.0, 2.0, 4.0))],
)
def test_disturbances_stay_within_the_bound(speeds, gain):
    """Constant, rotating, random and worst-case disturbances of size 1, from an error at the start."""
    m = regressor(0.0, *speeds, HALF_TRACK_M)
    a = error_matrix(m, np.array(gain), np.eye(2), float(m[2] @ [0.9, 0.8]))
    bound = disturbance_bound(a)
    step_s, n, rng = 0.1, 400, np.random.default_rng(0)
    exact = expm(step_s * np.block([[a, np.eye(5)], [np.zeros((5, 10))]]))
    ahead, driven = exact[:5, :5], exact[:5, 5:]
    final = np.linalg.svd(np.linalg.solve(a, np.eye(5)))[0][:, 0]
    backwards = [final @ expm(a * step_s * (n - k)) for k in range(n)]
    turning = [np.roll([np.cos(k * step_s), np.sin(k * step_s), 0, 0, 0], 1) for k in range(n)]
    for forces in (np.tile(final, (n, 1)), turning, rng.normal(size=(n, 5)), backwards):
        unit = forces / np.linalg.norm(forces, axis=1, keepdims=True)
        x = start = rng.normal(size=5)
        for k, force in enumerate(unit):
            x = ahead @ x + driven @ force
            decayed = (
                bound.overshoot_ratio * np.exp(-bound.rate_ps * step_s * (k + 1)) * np.linalg.norm(start)
            )
            assert np.linalg.norm(x) <= decayed + bound.disturbance_s


# -- Forces on a tracked robot on a grade (Yamauchi et al.)

PATAKO = load_robot("patako")
SAND = load_soil("toyoura_sand")


@pytest.mark.parametrize("grade", [-0.2, 0.0, 0.1, 0.3])
def test_the_thrust_is_the_integral_of_the_shear_stress(grade):
    found = track_balance(PATAKO, SAND, grade)
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


def test_beyond_reach_there_is_no_slip_and_hard_ground_is_refused():
    assert math.isnan(track_balance(PATAKO, SAND, SAND.friction_angle_rad).slip_ratio)
    with pytest.raises(ConfigError, match="janosi"):
        track_balance(PATAKO, load_soil("asphalt"), 0.0)


def test_it_is_the_slip_of_the_simulated_robot():
    belts = np.full((400, 2), 0.05)
    for grade in (0.0, 0.15, 0.3):
        run = simulate(PATAKO, belts, SAND, 0, slope=Slope(grade), sensors=QUIET)
        slip = 1 - run.streams["truth"].channel("speed_x_mps")[-1] / 0.05
        # the simulated pressure moves to the rear on a grade, where the soil has been sheared further
        assert slip == pytest.approx(track_balance(PATAKO, SAND, grade).slip_ratio, rel=0.2, abs=0.002)


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
