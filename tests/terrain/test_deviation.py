"""The deviation of runs from a robot's simulation: written and read again, and refused where it cannot be."""

import numpy as np
import pytest
import yaml

from terrain.deviation import ChannelDeviation, Deviation, deviation_lines, read_deviation
from terrain.errors import ConfigError
from terrain.extension import extended_yaml
from terrain.robots import load_robot, robot_from

GIVEN = Deviation(
    2.5,
    6.25,
    {
        "yaw_rate_radps": ChannelDeviation(0.01, 0.02, 0.03, 2.2, 24),
        "speed_x_mps": ChannelDeviation(0.0, 0.1, 0.0, 1.9, 9),
    },
)


def test_a_robot_is_written_and_read_with_its_deviation(tmp_path):
    text = extended_yaml("husky", {}, np.empty((0, 0)), {}, "me", deviation=GIVEN)
    assert robot_from("mine.yaml", yaml.safe_load(text)).deviation == GIVEN
    (tmp_path / "mine.yaml").write_text(text)
    assert "deviation:" not in extended_yaml(tmp_path / "mine.yaml", {}, np.empty((0, 0)), {}, "me")
    assert load_robot("husky").deviation is None


def test_a_robot_that_stands_deviates_less_than_one_that_drives_and_turns():
    own = GIVEN.channels["yaw_rate_radps"]
    speeds, turns = np.array([0.0, 1.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0, -1.0])
    expected = np.sqrt([1e-4, 5e-4, 10e-4, 14e-4])
    np.testing.assert_allclose(own.std(speeds, turns), expected)
    np.testing.assert_allclose(own.half_95(speeds, turns), 2.2 * expected)


@pytest.mark.parametrize(
    ("place", "changes", "message"),
    [
        ((), {"schema": 2}, "schema is 2"),
        ((), {"noise": 1.0}, "key 'noise' is unknown"),
        ((), {"channels": []}, r"channels are \[\]"),
        (("low_pass",), {"rate_hz": 0.0}, "are no low-pass"),
        (("low_pass",), {"cutoff_hz": "fast"}, "'fast' is no finite number"),
        (
            ("channels",),
            {"speed": dict.fromkeys(ChannelDeviation._fields, 1.0)},
            "the channel 'speed' is unknown",
        ),
        (("channels", "yaw_rate_radps"), {"at_rest": -1.0}, "deviations from 0 up"),
        (("channels", "speed_x_mps"), {"per_speed": 0.0}, "not all 0"),
        (("channels", "speed_x_mps"), {"times_95": 0.0}, "a factor above 0"),
        (("channels", "speed_x_mps"), {"std": 1.0}, "key 'std' is unknown"),
    ],
)
def test_a_deviation_that_cannot_be_is_refused_in_one_sentence(place, changes, message):
    section = yaml.safe_load("\n".join(deviation_lines(GIVEN)))["deviation"]
    entry = section
    for key in place:
        entry = entry[key]
    entry |= changes
    with pytest.raises(ConfigError, match=message) as refused:
        read_deviation("mine.yaml: deviation", section)
    assert str(refused.value).startswith("mine.yaml: deviation")
    assert "\n" not in str(refused.value)
