import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import lfilter

from terrain.control.pid import (
    LONGEST_STEP_S,
    Gains,
    PidState,
    PidStatus,
    check_gains,
    pid_step,
)
from terrain.errors import ConfigError

DT_S = 0.02
WIDE = 1e9
NAN = math.nan


def outputs(gains, errors, dt_s=DT_S, state=PidState()):  # noqa: B008 - a value, not a thing
    found = []
    for error in errors:
        output, state, status = pid_step(gains, state, float(error), dt_s)
        found.append((output, state, status))
    return found


@pytest.mark.parametrize("tau_s", [0.0, 0.05])
def test_within_its_limits_it_is_the_linear_filter(tau_s):
    error = np.random.default_rng(0).standard_normal(500)
    gains = check_gains(Gains(1.5, 0.7, 0.2, WIDE, derivative_time_constant_s=tau_s))
    share = 1 - math.exp(-DT_S / tau_s) if tau_s else 1.0
    rate = lfilter([share / DT_S, -share / DT_S], [1.0, share - 1.0], error - error[0])
    expected = 1.5 * error + 0.7 * DT_S * np.cumsum(error) + 0.2 * rate
    assert [output for output, *_ in outputs(gains, error)] == pytest.approx(expected, abs=1e-10)


def test_the_integral_removes_a_constant_disturbance():
    gains, state, level = check_gains(Gains(2.0, 4.0, 0.0, 10.0)), PidState(), 0.0
    for _ in range(2000):
        output, state, _ = pid_step(gains, state, 1.0 - level, DT_S)
        level += DT_S * (output - level - 3.0)
    assert level == pytest.approx(1.0, abs=1e-9)
    assert state.integral == pytest.approx(4.0, abs=1e-8)


@given(
    st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60),
    st.tuples(st.floats(0, 10), st.floats(0, 100), st.floats(0, 1), st.floats(0.01, 10), st.floats(0.01, 20)),
)
def test_output_and_integral_keep_their_limits_and_do_not_wind_up(errors, numbers):
    gains = check_gains(Gains(*numbers, derivative_time_constant_s=0.05))
    integral = 0.0
    for error, (output, state, status) in zip(errors, outputs(gains, errors), strict=True):
        assert abs(output) <= gains.limit
        assert status in (PidStatus.OK, PidStatus.CLAMPED)
        assert status == PidStatus.OK or abs(output) == gains.limit
        assert abs(state.integral) <= gains.integral_limit
        if status == PidStatus.CLAMPED and output * error > 0:
            assert abs(state.integral) <= abs(integral)
        integral = state.integral


def test_after_a_long_stop_against_the_limit_it_comes_back_at_once():
    gains = check_gains(Gains(1.0, 2.0, 0.0, 1.0))
    found = outputs(gains, [5.0] * 1000 + [-0.1])
    assert [status for *_, status in found[-2:]] == [PidStatus.CLAMPED, PidStatus.OK]
    assert found[-1][0] < 0.0  # an integral that had gone on would hold it at 1 for a minute and a half


def test_an_integral_beyond_a_limit_that_was_lowered_comes_down():
    gains = check_gains(Gains(1.0, 2.0, 0.0, 1.0))
    output, state, status = pid_step(gains, PidState(5.0), -0.1, DT_S)
    assert (output, status) == (1.0, PidStatus.CLAMPED)
    assert state.integral == pytest.approx(5.0 - 2.0 * 0.1 * DT_S)


@pytest.mark.parametrize(
    ("error", "dt_s", "status"),
    [
        (NAN, DT_S, PidStatus.NO_ERROR),
        (math.inf, DT_S, PidStatus.NO_ERROR),
        (-math.inf, DT_S, PidStatus.NO_ERROR),
        (1.0, 0.0, PidStatus.BAD_TIME),
        (1.0, -0.02, PidStatus.BAD_TIME),
        (1.0, NAN, PidStatus.BAD_TIME),
        (1.0, np.nextafter(LONGEST_STEP_S, 1.0), PidStatus.BAD_TIME),
        (NAN, NAN, PidStatus.BAD_TIME),
    ],
)
def test_a_fault_gives_nothing_freezes_the_integral_and_leaves_no_kick(error, dt_s, status):
    gains = check_gains(Gains(1.0, 1.0, 5.0, 100.0, derivative_time_constant_s=0.02))
    _, before, _ = outputs(gains, [0.3, 0.4, 0.5])[-1]
    output, after, found = pid_step(gains, before, error, dt_s)
    assert (output, after.integral, found) == (0.0, before.integral, status)
    assert PidStatus(found).label in ("bad time", "no error")
    resumed, _, _ = pid_step(gains, after, 50.0, DT_S)
    assert resumed == pytest.approx(50.0 + before.integral + 50.0 * DT_S)  # no derivative over the gap


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kp": -0.1}, "gain kp is -0.1, a finite number from zero up is required"),
        ({"ki": NAN}, "gain ki is nan"),
        ({"kd": math.inf}, "gain kd is inf"),
        ({"kp": "1"}, "gain kp is '1'"),
        ({"kp": True}, "gain kp is True"),
        ({"derivative_time_constant_s": -1}, "gain derivative_time_constant_s is -1"),
        ({"limit": 0}, "gain limit is 0, a finite number above zero is required"),
        ({"limit": math.inf}, "gain limit is inf"),
        ({"integral_limit": 0.0}, "gain integral_limit is 0.0, a number above zero is required"),
        ({"integral_limit": NAN}, "gain integral_limit is nan"),
    ],
)
def test_invalid_gains_are_refused_in_one_sentence(change, message):
    with pytest.raises(ConfigError) as refused:
        check_gains(Gains(1.0, 0.0, 0.0, 1.0)._replace(**change))
    assert str(refused.value).startswith(message)
    assert "\n" not in str(refused.value)
