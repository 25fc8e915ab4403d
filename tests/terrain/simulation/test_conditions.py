import math

import numpy as np
import pytest
from scipy.stats import chi2

from terrain.errors import ConfigError
from terrain.simulation.scenario import Conditions, Faults, draw_conditions, field_spread


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"payload_kg": math.nan}, "payload_kg is nan, a number from zero up"),
        ({"payload_kg": -1.0}, "payload_kg is -1.0, a number from zero up"),
        ({"payload_m": (0.0, math.inf)}, r"payload_m is \(0.0, inf\), a finite number"),
        ({"grade_ratio": (0.0, 1.2)}, r"grade_ratio is \(0.0, 1.2\), a gradient from -1 to 1"),
        ({"undulation_ratio": -2.0}, "undulation_ratio is -2.0"),
        ({"undulation_length_m": 0.0}, "undulation_length_m is 0.0, a number above zero"),
        ({"radius_factors": (1.0, 0.0, 1.0)}, r"radius_factors is \(1.0, 0.0, 1.0\), a number above zero"),
        ({"roughness_factor": -0.1}, "roughness_factor is -0.1, a number from zero up"),
        ({"leg_backlash_rad": -0.01}, "leg_backlash_rad is -0.01, an angle from 0 to 0.5 rad"),
        ({"leg_backlash_rad": math.nan}, "leg_backlash_rad is nan"),
        ({"field_length_m": math.nan}, "field_length_m is nan"),
    ],
)
def test_impossible_conditions_are_refused(changed, message):
    with pytest.raises(ConfigError, match=message):
        Conditions(**changed)


@pytest.mark.parametrize("interval", [(3.0, 2.0), (2.0, 2.0), (math.nan, 2.0), (0.0, math.nan)])
@pytest.mark.parametrize("name", ["camera_lost_s", "gnss_lost_s"])
def test_an_interval_that_does_not_end_after_it_starts_is_refused(name, interval):
    with pytest.raises(ConfigError, match=f"{name} has .* start before end"):
        Faults(**{name: ((0.0, 1.0), interval)})


def test_conditions_scatter_around_the_nominal_ones_as_the_spread_says():
    spread, n = field_spread(), 800
    nominal = Conditions(
        payload_kg=5.0,
        payload_m=(0.05, -0.02),
        grade_ratio=(0.05, 0.0),
        undulation_ratio=0.01,
        radius_factors=(1.02, 1.0, 0.97),
        roughness_factor=2.0,
    )
    rng = np.random.default_rng(1)
    drawn = [draw_conditions(rng, nominal) for _ in range(n)]
    cut = 0.9594  # standard deviation of a normal clipped at two
    low, high = np.sqrt(chi2.ppf([1e-5, 1 - 1e-5], n - 1) / (n - 1))
    for name, centre, std in (
        ("grade_ratio", nominal.grade_ratio, spread["grade_std_ratio"]),
        ("undulation_ratio", 0.01, spread["undulation_std_ratio"]),
        ("radius_factors", nominal.radius_factors, spread["radius_std_ratio"]),
    ):
        values = np.array([getattr(one, name) for one in drawn])
        np.testing.assert_allclose(values.mean(axis=0), centre, atol=4.5 * std / math.sqrt(n))
        assert (np.abs(values - centre) <= 2.0001 * std * np.maximum(1.0, centre)).all()
        ratio = values.std(axis=0) / std
        assert ((ratio > low * cut) & (ratio < high)).all(), name
    log = np.log([one.roughness_factor for one in drawn])
    assert log.mean() == pytest.approx(
        math.log(2.0), abs=4.5 * spread["roughness_log_std_ratio"] / math.sqrt(n)
    )
    payload = np.array([one.payload_kg for one in drawn])
    assert 5.0 <= payload.min() < 6.0 < 34.0 < payload.max() <= 35.0
    place = np.array([one.payload_m for one in drawn]) - nominal.payload_m
    assert 0.14 < np.abs(place).max() <= 0.15
    assert len(set(drawn)) == n
