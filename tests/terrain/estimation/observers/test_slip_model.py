"""The slip model: derivatives, continuity from straight motion to a spin, mirror images, printed laws."""

import math

import numpy as np
import pytest

from terrain.errors import ConfigError
from terrain.estimation.observers.slip_model import (
    ANGLE,
    GYRO_BIAS,
    N_MODEL,
    N_PARAMETERS,
    TRACK_RATIO,
    SlipModel,
    body_velocity,
    model_of,
    next_displacement,
    turn_weight,
)

D = 0.1965
MODEL = SlipModel(
    *(0.8, 0.05, 0.4, 0.3, 0.5),
    angle=np.array([0.05, 0.3, 0.2, -0.1, -1.2, -0.4, 0.05, 0.1]),
    track_ratio=1.5,
    turn_side_m=0.2,
    turn_shift_m=0.15,
)


def theta_of(model=MODEL):
    return np.concatenate([model.vector, np.zeros(N_PARAMETERS - N_MODEL)])


def velocity(left, right, w, roll=0.1, pitch=-0.05, displacement=0.3, theta=None):
    slopes = np.empty((2, N_PARAMETERS))
    theta = theta_of() if theta is None else theta
    return np.array(body_velocity(theta, D, (left, right), w, (roll, pitch), displacement, slopes)), slopes


@pytest.mark.parametrize(("left", "right"), [(0.05, 0.06), (-0.02, 0.12), (0.1, 0.02), (-0.1, -0.03)])
def test_derivatives_are_numerical(left, right):
    w = 0.6 * (right - left) / (2 * D)
    _, slopes = velocity(left, right, w)
    step = 1e-6
    for i in range(N_PARAMETERS):
        theta = np.tile(theta_of(), (2, 1))
        theta[:, i] += (-step, step)
        low, high = (velocity(left, right, w, theta=each)[0][:2] for each in theta)
        expected = 0.0 if i in (TRACK_RATIO, GYRO_BIAS) else (high - low) / (2 * step)
        assert slopes[:, i] == pytest.approx(expected, abs=1e-7)
    fixed = theta_of()
    fixed[ANGLE + 3] = 0.0  # dV_y/dw is that at constant beta
    by_rate = velocity(left, right, w, theta=fixed)[0][2:]
    ahead, behind = (velocity(left, right, w + s, theta=fixed)[0][:2] for s in (step, -step))
    assert by_rate == pytest.approx((ahead - behind) / (2 * step), abs=1e-7)


def test_straight_motion_is_the_straight_law():
    v_x, v_y, _, _ = velocity(0.1, 0.1, 0.0, roll=0.2, pitch=-0.1)[0]
    assert v_x == pytest.approx(0.1 * (1 - 0.05 - 0.4 * 0.1))
    assert v_y == pytest.approx(-v_x * 0.5 * 0.2)


def test_gravity_sets_the_sign_in_reverse():
    v_x, v_y, _, _ = velocity(-0.1, -0.1, 0.0, roll=0.2, pitch=-0.1)[0]
    assert v_x == pytest.approx(-0.1 * (1 - 0.05) - 0.1 * 0.4 * 0.1)  # backing down the grade, gravity helps
    assert v_y == pytest.approx(-abs(v_x) * 0.5 * 0.2)


def sweeps():
    s = np.linspace(-1, 1, 4001)
    yield "straight to spin", 0.05 - 0.1 * np.abs(s), 0.05 + 0.1 * np.abs(s)
    yield "left track stops", 0.05 * s, np.full_like(s, 0.1)
    yield "right track stops", np.full_like(s, 0.1), 0.05 * s
    yield "spin to reverse", -0.1 + 0.05 * s, 0.1 + 0.05 * s
    yield "forward to reverse", 0.1 * s, 0.08 * s
    yield "left turn to right turn", 0.1 + 0.03 * s, 0.1 - 0.03 * s


@pytest.mark.parametrize("n", [0.3, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("sweep", list(sweeps()), ids=lambda each: each[0])
def test_the_velocity_has_no_jump(n, sweep):
    _, left, right = sweep
    theta = theta_of()
    theta[0] = n
    w = 0.6 * (right - left) / (2 * D)

    def largest_step(every):
        chosen = slice(None, None, every)
        found = np.array(
            [
                velocity(*each, displacement=0.0, theta=theta)[0][:2]
                for each in zip(left[chosen], right[chosen], w[chosen], strict=True)
            ]
        )
        return np.abs(np.diff(found, axis=0)).max()

    coarse, fine = largest_step(4), largest_step(1)
    assert fine < 0.72 * coarse  # it falls with the step: |v|^(1/2) halves over a quarter of it
    assert fine < 0.01


def test_turns_to_the_right_and_in_reverse_are_mirror_images():
    v_x, v_y, _, _ = velocity(-0.02, 0.12, 0.25)[0]
    right = velocity(0.12, -0.02, -0.25, roll=-0.1, displacement=-0.3)[0]
    assert right[:2] == pytest.approx([v_x, -v_y])
    back = velocity(0.02, -0.12, -0.25, pitch=0.05, displacement=-0.3)[0]
    assert back[:2] == pytest.approx([-v_x, v_y])


def test_a_turn_is_the_regression_and_the_drift():
    x = np.array([1, 0.05, 0.14 / (2 * D), 0.25, 0.1, -0.05, 0.3, np.arccos(np.cos(0.1) * np.cos(0.05))])
    v_x, v_y, _, _ = velocity(-0.02, 0.12, 0.25)[0]
    drift = -0.2 * 0.25 * 0.1 + 0.15 * 0.25 * 0.05
    assert v_y == pytest.approx(v_x * math.tan(float(x @ MODEL.angle)) + drift)


def test_weight_and_displacement_of_a_turn():
    assert turn_weight(0.0, 0.0) == turn_weight(0.05, 0.05) == 0.0
    assert turn_weight(0.0, 0.1) == turn_weight(-0.1, 0.1) == 1.0
    turned = 0.0
    for _ in range(100):
        turned = next_displacement(turned, (-0.02, 0.12), 0.5, 0.6, 0.01)
    assert turned == pytest.approx(0.5)
    for _ in range(100):
        turned = next_displacement(turned, (0.6, 0.6), 0.0, 0.6, 0.01)
    assert turned == pytest.approx(0.5 * math.exp(-1))


def test_a_model_refuses_what_it_cannot_be():
    with pytest.raises(ConfigError, match="finite"):
        SlipModel(turning_exponent=math.nan)
    with pytest.raises(ConfigError, match="shape"):
        SlipModel(angle=np.zeros(3))
    with pytest.raises(ConfigError, match="above zero"):
        SlipModel(track_ratio=0.0)
    again = model_of(MODEL.vector, covariance=MODEL.covariance)
    assert (again.vector == MODEL.vector).all()
    assert ANGLE + len(MODEL.angle) == TRACK_RATIO
