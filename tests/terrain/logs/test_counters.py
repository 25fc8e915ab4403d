"""Counters that wrap, rates in mappings, and the log of a tricycle in ticks."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipelines.data.datasets import load_runs
from terrain.errors import ConfigError, LogError
from terrain.logs.counters import count_rates, unwrapped_counts
from terrain.logs.mapping import load_mapping, load_topics

STEPS = st.lists(st.integers(-1000, 1000), min_size=2, max_size=30)


@given(STEPS, st.integers(0, 2**16 - 1))
def test_a_counter_that_wraps_counts_what_was_driven(steps, start):
    driven = start + np.cumsum([0, *steps])
    assert np.array_equal(unwrapped_counts(driven % 2**16 * 1.0, 2.0**16) - start % 2**16, driven - start)


@given(STEPS)
def test_rates_sum_to_the_counts_whatever_the_steps(steps):
    """Every step is in the rates of the two samples around it, half in each, where samples are even."""
    counted = np.cumsum([0.0, *steps])
    rates = count_rates(np.arange(len(counted)) * 0.5, counted)
    inner = 0.5 * (rates[0] + rates[-1]) + rates[1:-1].sum()
    assert np.isclose(inner * 0.5, counted[-1] - counted[0])


def test_a_rate_is_as_late_as_its_counts():
    time_s = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.03, 400))
    assert np.allclose(count_rates(time_s, np.sin(time_s))[1:-1], np.cos(time_s)[1:-1], atol=0.02)


MAPPING = """
robot: husky
run_id: "{run}"
streams:
  wheels:
    file: "{run}.csv"
    time: {column: t, unit: s}
    channels:
      speed_left_mps: {column: left, unit: mm, scale: 2.0, rate: true, wraps: 256}
      speed_right_mps: {column: right, unit: m/s}
"""


def test_a_mapped_counter_becomes_a_speed(tmp_path):
    (tmp_path / "map.yaml").write_text(MAPPING)
    rows = [f"{0.1 * k:g},{(250 + 5 * k) % 256},0.1" for k in range(9)]
    (tmp_path / "a.csv").write_text("t,left,right\n" + "\n".join(rows) + "\n")
    (run,) = load_runs(tmp_path, mapping=tmp_path / "map.yaml")
    assert np.allclose(run.streams["wheels"].values, 0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("unit: mm, scale", "unit: m/s, scale"),
            "unit 'm/s' does not suit it (accepted here: m, cm, mm, km)",
        ),
        (("wraps: 256", "wraps: 0"), "wraps"),
        (("rate: true", "rate: maybe"), "rate"),
        (("speed_left_mps", "current_left_a"), "'rate' is for channels in m/s, rad/s or m/s^2"),
    ],
)
def test_a_rate_that_cannot_be_is_one_sentence(tmp_path, change, message):
    (tmp_path / "map.yaml").write_text(MAPPING.replace(*change))
    with pytest.raises(ConfigError) as error:
        load_mapping(tmp_path / "map.yaml")
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_packaged_mappings_are_found_by_name():
    assert load_mapping("race_car").robot == "av21"
    assert load_topics("omnirobot_topics").streams["wheels"].channels["speed_rear_left_mps"].rate


HEAD = """#kinematic_model: traction_drive_wheel
#parameters: [ Ksteer Ktraction axis_length steer_offset ]
#parameter_values: 0.1 0.01 1.4 0
#joints_max_enc: [ steering traction_wheel ]
#joints_max_enc_values: 8192 5000
"""


def ticks(n=40, change=lambda lines: lines, head=HEAD):
    """Return a log of a drive at 0.02 m/s, its steering at -2 steps, whose counter wraps at row 9."""
    lines = []
    for k in range(n):
        count = (2**32 - 1500 + 400 * k) % 2**32
        lines.append(
            f"time: {100 + 0.04 * k:.3f} ticks: 8190 {count} model_pose: 0 0 0 tracker_pose: {k} 0 0.1"
        )
    return head + "\n".join(change(lines)) + "\n"


@pytest.fixture
def tricycle(tmp_path):
    def write(text, name="drive.txt"):
        path = tmp_path / name
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
        return tmp_path

    return write


@pytest.mark.parametrize("name", ["drive.txt", "drive.txt.gz"])
def test_ticks_of_a_tricycle_become_speed_angle_and_pose(tricycle, name):
    (run,) = load_runs(tricycle(ticks(), name))
    assert (run.run_id, run.robot) == ("drive", "pallet_truck")
    assert np.allclose(run.streams["wheels"].channel("speed_front_mps"), 400 / 5000 * 0.01 / 0.04)
    assert np.allclose(run.streams["steering"].channel("angle_front_rad"), -2 * 2 * np.pi / 8192)
    assert np.allclose(run.streams["pose"].channel("position_x_m"), np.arange(40))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            ticks(change=lambda lines: [*lines[:5], "time: 1 ticks: a"]),
            "row 11 is 'time: 1 ticks: a', 'time: s",
        ),
        (ticks(change=lambda lines: lines[:1]), "has 1 usable rows of data, at least 2 are needed"),
        (ticks(change=lambda lines: lines[::-1]), "time goes back at row 7"),
        (
            ticks(head=HEAD.replace("0.01 1.4", "nan 1.4")),
            "its head does not state 'Ktraction' as a number above",
        ),
        (ticks(head=HEAD.replace("8192 5000", "8192")), "its head does not state 'traction_wheel'"),
        (ticks(head=HEAD.replace("0.01", "1000")), "the counter of the driven wheel changes by 2e+03 m/s"),
    ],
)
def test_a_damaged_log_of_a_tricycle_is_one_sentence(tricycle, text, message):
    with pytest.raises(LogError) as error:
        load_runs(tricycle(text))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_damaged_line_is_left_out_by_a_repairing_read(tricycle):
    folder = tricycle(ticks(change=lambda lines: [*lines[:5], "time: 1 ticks: a", *lines[5:]]))
    (run,) = load_runs(folder, repair=True)
    assert sum(run.dropped.values()) == 1
    assert len(run.streams["wheels"]) == 40


def test_other_texts_are_no_logs_of_a_tricycle(tricycle):
    with pytest.raises(LogError, match="holds no run"):
        load_runs(tricycle("notes\n", "readme.txt"))
