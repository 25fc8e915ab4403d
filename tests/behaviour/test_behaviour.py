"""What the commands compute is what is kept in ``expected``, and the comparison sees where it is not."""

from __future__ import annotations

import copy

import pytest

from . import compare
from .commands import CASES, COMMANDS
from .compare import differences
from .record import keep_result, load_result, outline, run_case, statistics

RESULT = {
    "verdict": "as printed",
    "robot": "husky",
    "run_ids": ["grass_01", "grass_02"],
    "reason": "the runs show nothing of it",
    "seconds": 1.25,
    "run_id": "36466bf127cd46e987d8765c6cb43779",
    "value": 0.25,
    "interval": [0.2, 0.3],
    "beside": {"true slip": 0.1, "factor 1": 0.2},
    "importance": [{"feature": "imu.gyro", "drop": 0.1}, {"feature": "imu.accel", "drop": 0.1}],
    "stream": {"time_s": statistics([0.0, 0.1, 0.2])},
    "page": outline("<section><h2>Verdict</h2></section><section><h2>Causes</h2><table></table></section>"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_case_reproduces_its_recorded_result(case, tmp_path):
    expected, result = load_result(case.name), run_case(case, tmp_path)
    found = differences(expected, compare.settled(expected, result, compare.LOOSE.get(case.name, {})))
    assert not found, f"{len(found)} differences\n" + "\n".join(found[:40])


def test_every_command_has_a_case():
    assert {words.split()[0] for case in CASES for words in case.steps} - {"!"} == set(COMMANDS)
    assert set(load_result("help")["help"]["terrain"]["commands"]) == set(COMMANDS)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda r: r.update(value=0.25 * (1 + 1e-8)), "/value"),
        (lambda r: r.update(value="0.25"), "/value"),
        (lambda r: r.update(value=None), "/value"),
        (lambda r: r.update(value=float("nan")), "/value"),
        (lambda r: r["interval"].append(0.4), "/interval"),
        (lambda r: r["interval"].__setitem__(1, 0.31), "/interval/1"),
        (lambda r: r.pop("value"), "/value"),
        (lambda r: r.update(more=1), "/more"),
        (lambda r: r.update(robot="agrimaro"), "/robot"),
        (lambda r: r.update(verdict="differs"), "/verdict"),
        (lambda r: r["run_ids"].reverse(), "/run_ids/0"),
        (lambda r: r.update(reason=""), "/reason"),
        (lambda r: r.pop("seconds"), "/seconds"),
        (lambda r: r.update(run_id="field"), "/run_id"),
        (lambda r: r["beside"].update({"true slip": 0.11}), "/beside/true slip"),
        (lambda r: r["importance"][0].update(drop=0.2), "/importance/imu.gyro/drop"),
        (lambda r: r.update(stream={"time_s": statistics([0.0, 0.11, 0.2])}), "/stream/time_s/sum"),
        (lambda r: r.update(stream={"time_s": statistics([0.0, float("nan"), 0.2])}), "/stream/time_s/nan"),
        (lambda r: r.update(page=outline("<section><h2>Verdict</h2><table></table></section>")), "/page/h2"),
        (lambda r: r["page"].update(section=1), "/page/section"),
        (lambda r: r["page"].update(h2=["Verdict", "What it is"]), "/page/h2/1"),
        # words and times may change, and what rounds differently
        (lambda r: None, ""),
        (lambda r: r.update(value=0.25 * (1 + 1e-10)), ""),
        (lambda r: r.update(reason="nothing of it is in these runs"), ""),
        (lambda r: r.update(seconds=7.0), ""),
        (lambda r: r.update(run_id="0" * 32), ""),
        (lambda r: r.update(beside={"the true slip": 0.1, "factor 1": 0.2}), ""),
        (lambda r: r["importance"].reverse(), ""),
    ],
)
def test_each_change_of_what_was_computed_is_detected_and_no_other(change, where):
    result = copy.deepcopy(RESULT)
    change(result)
    found = [line.partition(":")[0] for line in differences(RESULT, result)]
    assert where in found if where else found == []


def test_a_sum_that_cancels_is_as_accurate_as_its_summands():
    one = {**statistics([1e6, -1e6, 0.0]), "sum": 0.0}
    assert differences(one, {**one, "sum": 1e-6}) == []
    assert differences(one, {**one, "sum": 1.0}) == ["/sum: 0.0 was expected, it is 1.0"]


def test_a_result_is_kept_and_read_back(tmp_path):
    assert keep_result("small", RESULT, tmp_path).suffix == ".json"
    assert load_result("small", tmp_path) == RESULT
    big = {"names": [f"run_{i}" for i in range(20_000)]}
    kept = keep_result("big", big, tmp_path)
    assert kept.suffix == ".gz"
    assert load_result("big", tmp_path) == big
    content = kept.read_bytes()
    assert keep_result("big", big, tmp_path).read_bytes() == content


def test_only_listed_paths_are_compared_loosely():
    expected = {"a": [{"b": 1.0}], "c": 1.0}
    near = {"a": [{"b": 1.0001}], "c": 1.0001}
    assert differences(expected, compare.settled(expected, near, {"/a": 1e-3})) == [
        "/c: 1.0 was expected, it is 1.0001"
    ]
    assert len(differences(expected, compare.settled(expected, near, {"/a": 1e-5}))) == 2
