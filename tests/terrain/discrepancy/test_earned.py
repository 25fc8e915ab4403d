"""A cause is named where it earns it on data that it was not fitted to; a set extends by one of its members."""

from dataclasses import replace

import numpy as np
import pytest

from terrain.discrepancy import diagnose as diagnose_module
from terrain.discrepancy import earned
from terrain.discrepancy import gain as gain_module
from terrain.discrepancy.diagnose import diagnose, find_causes
from terrain.discrepancy.diagnosed_runs import diagnose_runs, held_out_gain
from terrain.discrepancy.earned import crossed_runs, judge, likelier_with
from terrain.discrepancy.gain import part_removed, ratio_of_sums, removed_by, weights_of
from terrain.discrepancy.held_out import split_runs
from terrain.discrepancy.verdict import Tier
from terrain.effects import CHANNELS, effect_named
from terrain.records import Stream
from terrain.robots import load_robot

pytestmark = pytest.mark.usefixtures("without_next_drive")
HUSKY = load_robot("husky")
FEW = tuple(map(effect_named, ("camera_yaw", "lever_arm", "gyro_scale", "effective_track", "wheel_radius")))
YAW = {"camera_yaw_rad": 0.05}


def diagnosed(runs, hold_out=2, library=FEW, robot=HUSKY):
    return diagnose_runs(runs, robot, library, hold_out, 0)


def of_channel(diagnosis, name):
    (verdict,) = [each for each in diagnosis.channels if each.channel == name]
    return verdict


@pytest.fixture(scope="module")
def turned(hide):
    """Return runs whose camera is turned."""
    return hide(YAW, n=8, duration_s=20.0)


@pytest.fixture(scope="module")
def right(turned, without_next_drive):
    """What is found in them."""
    return diagnosed(turned)


def planted(hide, name, value):
    """Return runs of which those that are held out have the opposite of what the others have."""
    runs, other = (hide({name: sign * value}, n=8, duration_s=20.0) for sign in (1, -1))
    ids = {run.run_id for run in split_runs(runs, 2, 0)[1]}
    return [there if run.run_id in ids else run for run, there in zip(runs, other, strict=True)]


def test_what_fits_the_runs_used_and_not_those_held_out_is_a_candidate_and_builds_nothing_in(hide, right):
    assert [cause.name for cause in right.diagnosis.causes] == ["camera_yaw"]
    assert right.diagnosis.verdict is Tier.NAMED
    wrong = diagnosed(planted(hide, "camera_yaw_rad", 0.05))
    assert (wrong.diagnosis.causes, wrong.extended) == ((), None)
    assert wrong.diagnosis.verdict is Tier.CANDIDATE
    (candidate,) = [each for each in wrong.diagnosis.candidates if each.name == "camera_yaw"]
    assert "on 2 runs held out: -" in candidate.reason
    assert candidate.parameters[0].value == pytest.approx(0.05, abs=0.01)
    assert of_channel(wrong.diagnosis, "speed_y_mps").tier is Tier.CANDIDATE


def test_a_gyro_whose_axes_are_exchanged_names_nothing_that_does_not_help(turned):
    """What the gyro measures has nothing to do with turning: the learner knows no better either."""
    exchanged = []
    for k, run in enumerate(turned):
        imu = run.streams["imu"]
        values = np.array(imu.values)
        rng = np.random.default_rng(k)
        place = imu.channels.index("gyro_z_radps")
        values[:, place] = np.convolve(rng.standard_normal(len(values)), np.ones(25) / 5.0, "same") * 0.3
        streams = {**run.streams, "imu": Stream(imu.time_s, values, imu.channels)}
        exchanged.append(replace(run, streams=streams))
    diagnosis = diagnosed(exchanged).diagnosis
    for cause in diagnosis.built_in:
        assert cause.gain_ci[0] > 0.0
    gyro = of_channel(diagnosis, "yaw_rate_radps") if "yaw_rate_radps" in diagnosis.gain.channels else None
    assert gyro is None or gyro.tier not in (Tier.NAMED, Tier.SET) or gyro.gain > 0.5 * gyro.learner_gain


def test_a_set_extends_the_simulation_by_its_best_member_and_gains(hide):
    """Without camera and heading a gyro's scale and an effective track are one and the same."""
    runs = []
    for run in hide({"gyro_scale_ratio": 0.065}, n=8):
        wheels = run.streams["wheels"]
        speeds = Stream(wheels.time_s, wheels.values[:, :2], wheels.channels[:2])
        runs.append(replace(run, streams={"wheels": speeds, "imu": run.streams["imu"]}))
    found = diagnosed(runs)
    diagnosis = found.diagnosis
    assert (diagnosis.verdict, diagnosis.causes) == (Tier.SET, ())
    assert {"gyro_scale", "effective_track"} <= set(diagnosis.ambiguous_sets[0])
    (built,) = diagnosis.of_sets
    assert built.tier is Tier.SET
    assert built.name in diagnosis.ambiguous_sets[0]
    assert found.extended.effects == pytest.approx(diagnosis.values)
    assert diagnosis.covariance.parameters == tuple(diagnosis.values)
    assert of_channel(diagnosis, "yaw_rate_radps").tier is Tier.SET
    assert held_out_gain(found, HUSKY, 0).gain.ci[0] > 0.0


def test_parts_of_few_runs_are_left_out_in_turn_and_what_was_built_in_gains_on_all(turned, right):
    few = turned[:4]
    by_parts = diagnose(few, diagnosed(few, None).simulation, FEW)
    assert [cause.name for cause in by_parts.causes] == ["camera_yaw"]
    assert by_parts.gain.how == "4 runs, runs of them left out of the fit in turn"
    ahead, beside = (d.gain.channels["speed_y_mps"].reduction for d in (by_parts, right.diagnosis))
    assert ahead == pytest.approx(beside, abs=0.1)
    effects = dict(YAW)
    extended = replace(HUSKY, effects=effects, effects_cov=np.array([[1e-6]]))
    again = diagnosed(few, None, robot=extended)
    assert (again.diagnosis.causes, again.extended) == ((), None)
    gain = held_out_gain(again, extended, 0).built_in_before
    assert len(gain.runs) == 4
    assert gain.channels["speed_y_mps"].reduction == pytest.approx(ahead, abs=0.1)
    assert held_out_gain(right, HUSKY, 0).built_in_before is None


def test_sessions_are_held_out_and_a_run_that_cannot_be_compared_is_excluded_with_its_reason(turned):
    runs = [replace(run, session=f"s{i % 4}") for i, run in enumerate(turned)]
    short = {name: Stream(s.time_s[:5], s.values[:5], s.channels) for name, s in runs[3].streams.items()}
    runs[3] = replace(runs[3], streams=short)
    found = diagnosed(runs)
    assert "of 1 session held out" in found.diagnosis.gain.how
    assert {run.session for run in found.used}.isdisjoint(run.session for run in found.held_out)
    (excluded,) = [run for run in found.diagnosis.excluded_runs if run.run_id == runs[3].run_id]
    assert "at least 4 s are required" in excluded.reason
    assert [cause.name for cause in found.diagnosis.causes] == ["camera_yaw"]


@pytest.mark.parametrize(
    ("reduction", "learner", "expected"),
    [(0.5, 0.9, True), (0.4, 0.9, False), (-0.1, -0.9, False), (0.2, -0.9, True)],
)
def test_a_gain_is_earned_above_0_and_by_half_of_the_learners(right, reduction, learner, expected):
    gain = right.diagnosis.gain._replace(reduction=reduction, learner_reduction=learner)
    assert gain_module.earned(gain) is expected


@pytest.mark.parametrize(("others", "is_named"), [(20.0, True), (5.0, False)])
def test_a_channel_made_slightly_worse_speaks_against_a_cause_that_removes_little_elsewhere(
    turned, right, monkeypatch, others, is_named
):
    """The cause adds 5 % to the square of the currents, over the noise, and removes some times that elsewhere."""
    simulation = right.simulation
    found = find_causes(turned, simulation, FEW)
    on = crossed_runs(found.problem.signals, simulation, found.problem.low_pass, found.noise, 0)
    assert judge(found.fit, found.built_in, on).reasons == {}
    weights = weights_of(on.noise)
    worse, better = CHANNELS.index("current_a"), CHANNELS.index("speed_y_mps")

    def worsened(*about):
        removed = removed_by(*about)
        squares = np.zeros_like(removed.squares)
        squares[:, :, worse] = np.array([1.0, 1.0, 1.05]) / weights[worse]
        squares[:, :, better] = np.array([0.05 * others, 0.05 * others, 0.0]) / weights[better]
        return removed._replace(squares=squares)

    monkeypatch.setattr(earned, "removed_by", worsened)
    reasons = judge(found.fit, found.built_in, on).reasons
    if is_named:
        assert reasons == {}
    else:
        assert "it makes sum of the motor currents worse, by 5 % of its square" in reasons["camera_yaw"]


@pytest.fixture(scope="module")
def on_held_out(turned, without_next_drive):
    """The fit to the runs used, what is built in, and the runs held out."""
    asked = {}

    def keep(*about):
        asked["about"] = about
        return judge(*about)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnose_module, "judge", keep)
        diagnosed(turned)
    return asked["about"]


@pytest.mark.parametrize("over", [1.0, 2.0, -1.0])
def test_how_much_likelier_runs_are_follows_from_how_much_of_a_value_they_have(on_held_out, over):
    fit, built, on = on_held_out
    names, values = [cause.name for cause in built], [{"camera_yaw_rad": 0.05 * over}]
    likelier, (low, high) = likelier_with(on.evidence(fit), values, [{}], on, on.plain)
    assert names == ["camera_yaw"]
    assert likelier == pytest.approx(2.0 / over - 1.0, abs=0.1)
    assert low < likelier < high


@pytest.mark.parametrize(
    ("likelier", "low", "is_named"), [(0.5, -0.5, True), (0.5, -1.5, False), (-0.1, -0.5, False)]
)
def test_of_causes_that_few_runs_confirm_together_one_goes_that_they_do_not_show(
    on_held_out, monkeypatch, likelier, low, is_named
):
    answers = iter([(0.9, (0.5, 1.3)), (likelier, (low, 1.5))])  # of all causes, then of one
    monkeypatch.setattr(earned, "likelier_with", lambda *_: next(answers))
    assert (judge(*on_held_out).reasons == {}) is is_named


def test_no_more_than_all_of_a_square_is_removed():
    part, whole = np.array([2.0, 1.8, 1.9]), np.full(3, 2.0)
    (_, (low, high)), (ratio, (least, most)) = ratio_of_sums(part, whole, 0), part_removed(part, whole, 0)
    assert high > 1.0
    assert (ratio, least, most) == (pytest.approx(0.95), low, 1.0)


@pytest.mark.parametrize(("size", "is_named"), [(0.05, True), (0.2, False)])
def test_a_size_that_no_builder_would_believe_is_never_named(hide, size, is_named):
    library = (effect_named("wheel_radius"), effect_named("camera_yaw"))
    diagnosis = diagnosed(hide({"wheel_radius_ratio": size}, n=8), library=library).diagnosis
    assert [cause.name for cause in diagnosis.causes] == ["wheel_radius"] * is_named
    if not is_named:
        (candidate,) = [each for each in diagnosis.candidates if each.name == "wheel_radius"]
        assert "something that is missing acts like" in candidate.reason
        assert candidate.parameters[0].value == pytest.approx(size, abs=0.02)
        assert of_channel(diagnosis, "speed_x_mps").tier is Tier.CANDIDATE


def test_candidates_for_one_channel_are_what_a_next_drive_decides_between(hide, monkeypatch):
    asked = []
    monkeypatch.setattr(diagnose_module, "next_drive", lambda simulation, sets, *_: asked.append(sets))
    library = tuple(map(effect_named, ("rolling_resistance", "viscous_drag", "payload", "camera_yaw")))
    diagnosis = diagnosed(planted(hide, "motor_drift_ratio", 0.6), library=library).diagnosis
    of_current = [each.name for each in diagnosis.candidates if each.channels[0] == "current_a"]
    assert len(of_current) > 1
    assert asked[-1] == [tuple(of_current[:3])]
    assert diagnosis.ambiguous_sets == ()
