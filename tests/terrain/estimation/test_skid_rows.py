"""The gyro's mean between ticks, and rest: their plain forms, and what only looks like rest."""

import numpy as np
import pytest

from terrain.estimation.feed import REST_ROW, REST_S, STEADY_RADPS, measurement_table, new_feed, rest_at
from terrain.records import RunLog, Stream
from terrain.robots import load_robot

HUSKY = load_robot("husky")
GYRO_S = np.arange(0.0, 40.0, 0.01)
WHEELS_S = np.arange(0.0, 39.9, 2 / 13)
RNG = np.random.default_rng(7)
NOISE = RNG.normal(0.0, 0.002, GYRO_S.size)


def run_of(gyro_radps, speed_mps=0.0, time_s=GYRO_S):
    axes = np.column_stack([NOISE[: time_s.size], -NOISE[: time_s.size], gyro_radps])
    wheels = np.broadcast_to(speed_mps, WHEELS_S.shape)
    return RunLog(
        "drive",
        "husky",
        {
            "wheels": Stream(
                WHEELS_S, np.column_stack([wheels, wheels]), ("speed_left_mps", "speed_right_mps")
            ),
            "imu": Stream(time_s, axes, ("gyro_x_radps", "gyro_y_radps", "gyro_z_radps")),
        },
    )


def rows_of(run):
    table = measurement_table(run, HUSKY)
    return table.time_s, *table.columns(["gyro_z_radps", REST_ROW]).T


def test_the_gyro_row_is_the_mean_since_the_last_tick():
    gyro = np.sin(GYRO_S) + 0.2 * np.cos(2 * np.pi * 6.5 * GYRO_S) + NOISE
    time_s, mean, _ = rows_of(run_of(gyro, 0.5))
    angle = np.append(0.0, np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(GYRO_S)))
    last = np.searchsorted(GYRO_S, time_s + 1e-9) - 1
    plain = np.diff(angle[last]) / np.diff(GYRO_S[last])
    np.testing.assert_allclose(mean[1:], plain, atol=1e-12)
    heading = np.sum(mean[1:] * np.diff(GYRO_S[last]))
    assert heading == pytest.approx(angle[last[-1]], abs=1e-9)
    sampled = np.sum(gyro[last][1:] * np.diff(time_s))  # what one sample a tick would make of it
    assert abs(sampled - heading) > 1.0


def test_rest_gives_the_mean_of_each_second():
    bias_radps = 0.03
    _, _, rest = rows_of(run_of(bias_radps + NOISE))
    known = rest[np.isfinite(rest)]
    assert known.size == pytest.approx(WHEELS_S[-1] / REST_S, rel=0.1)
    np.testing.assert_allclose(known, bias_radps, atol=6 * 0.002 / np.sqrt(90))


@pytest.mark.parametrize(
    ("gyro_radps", "speed_mps"),
    [
        (NOISE, 0.05),
        (NOISE, -0.05),
        (NOISE, np.nan),
        (0.5 + NOISE, 0.0),
        (NOISE + 2 * STEADY_RADPS * np.sign(np.sin(3 * GYRO_S)), 0.0),
        (np.where(np.arange(GYRO_S.size) % 90 < 60, np.nan, NOISE), 0.0),
    ],
    ids=["forward", "backward", "no wheels", "towed in a turn", "shaken", "no gyro"],
)
def test_what_is_no_rest_gives_nothing(gyro_radps, speed_mps):
    assert np.isnan(rows_of(run_of(gyro_radps, speed_mps))[2]).all()


def test_a_turn_that_begins_in_a_second_of_rest_is_no_part_of_the_row():
    gyro = NOISE + 0.5 * np.clip(GYRO_S - 10.0, 0.0, 1.0)
    time_s, _, rest = rows_of(run_of(gyro))
    assert np.nanmax(np.abs(rest)) < 0.002
    assert np.isnan(rest[(time_s > 10.3) & (time_s < 30.0)]).all()


def test_a_clock_that_is_set_back_starts_anew():
    feed = new_feed()[0]
    rows = [rest_at(time_s, 0.0, 0.0, 0.01, feed) for time_s in (5.0, 5.5, 2.0, 2.5, 3.0)]
    assert np.isnan(rows[:-1]).all()
    assert rows[-1] == 0.01
