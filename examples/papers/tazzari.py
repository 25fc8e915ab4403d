"""Tazzari et al.: experiments on simulated runs of the orchard vehicle; the claims are in tazzari.yaml."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from claims import Finding, Numbers, Trial
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from tracked_speed import TrackSpeedSettings, track_speed_step
from tracked_stability import ErrorBound, disturbance_bound, error_matrix, measured_efficiency, regressor
from tracks import janosi_slip

from pipelines.report.figure import Figure, Line, Mark, Panel, Points
from terrain.angles import wrapped
from terrain.constants import GRAVITY_MPS2
from terrain.estimation.models.observer import ObserverStatus, ObserverTrack, observe, rows_of
from terrain.estimation.models.tracked import TrackedObserver, TrackedSettings
from terrain.records import Array, RunLog
from terrain.robots import TrackedRobot, as_drive, load_robot
from terrain.simulation.plants.tracks import (
    LEVEL,
    NOISY,
    QUIET,
    STATE,
    STEP_S,
    PrescribedSlip,
    TrackedSensors,
    drive_tracks,
    rut_depth,
    tracks_on,
)
from terrain.simulation.run import simulate
from terrain.simulation.scenario import RATE_HZ as COMMANDS_HZ
from terrain.terramechanics.soil import Soil, load_soil
from terrain.terramechanics.traction import compaction_resistance, friction_limit

PAPER = TrackedSettings()
"""L and Lambda the identity, section V."""
NORMALISED = TrackedSettings(observation_gain_ps=(2.0, 2.0, 2.0), normalised=True)
"""The gain of this project: adaptation that does not depend on the speed."""
CONVERGED_RATIO = (0.05, 0.02)
"""Error over the true efficiency within which an estimate has converged."""
RUNS, FEW_RUNS = 5, 2
"""Number of runs that a figure is averaged over, and the number with ``quick``."""
SETTLED_S = 30.0
"""From when on errors are averaged."""


class TrackMotion(NamedTuple):
    """A motion at constant speeds of the tracks in m/s, and efficiencies.

    Pairs are (left, right); the paper prints none of these numbers, they are assumed.
    """

    speed_mps: tuple[float, float]
    eta_ratio: tuple[float, float]


CIRCLE = TrackMotion((0.4, 0.6), (1.10, 0.80))
STRAIGHT = TrackMotion((0.6, 0.6), (0.87, 0.87))
MOTIONS = {"circle": CIRCLE, "straight": STRAIGHT}


class ObservedRun(NamedTuple):
    """A run, the observer's track over it, its rows, and the truth at its ticks.

    Parameters
    ----------
    run : without the cameras around the field, which the paper does not have
    track : of the observer
    rows : (n, 6)
    pose : (n, 3) true position and heading
    eta : (n, 2) true efficiencies; NaN of a track that stands
    """

    run: RunLog
    track: ObserverTrack
    rows: Array
    pose: Array
    eta: Array

    @property
    def time_s(self) -> Array:
        """Times (n,) of the ticks."""
        return self.track.time_s

    @property
    def estimate(self) -> Array:
        """Estimated efficiencies (n, 2) of the left and the right track."""
        return np.column_stack([self.track.state("eta_left_ratio"), self.track.state("eta_right_ratio")])


def orchard_ugv() -> TrackedRobot:
    """Return the vehicle of the paper."""
    return as_drive(
        TrackedRobot, load_robot("orchard_ugv"), "robot {name!r} is {drive}, a tracked one is required"
    )


def observed(
    ground: Soil | PrescribedSlip,
    speeds_mps: Array,
    seed: int | np.random.SeedSequence,
    settings: TrackedSettings = PAPER,
    sensors: TrackedSensors = NOISY,
    lost_s: tuple[float, float] = (0.0, 0.0),
) -> ObservedRun:
    """Simulate a run and observe it.

    Parameters
    ----------
    ground : a soil, or slip that is given
    speeds_mps : (n, 2) commanded speeds of the tracks at 50 Hz
    seed : of the noise
    settings : of the observer
    sensors : of the vehicle
    lost_s : between which times there is no fix
    """
    robot = orchard_ugv()
    run = simulate(robot, speeds_mps, ground, seed, sensors=sensors)
    streams = {name: stream for name, stream in run.streams.items() if name != "pose"}
    run = replace(run, streams=streams)
    observer = TrackedObserver(robot, settings)
    time_s, rows, _ = rows_of(run, robot, observer.rows)
    rows[(time_s >= lost_s[0]) & (time_s < lost_s[1]), 2:5] = np.nan
    truth = streams["truth"]
    at = np.minimum(np.searchsorted(truth.time_s, time_s - 1e-6), len(truth.time_s) - 1)
    pose = np.column_stack([truth.channel(name)[at] for name in ("position_x_m", "position_y_m", "yaw_rad")])
    forward, turn = (truth.channel(name)[at] for name in ("speed_x_mps", "yaw_rate_radps"))
    eta = measured_efficiency(forward, turn, rows[:, 0], rows[:, 1], robot.half_track_m)
    if isinstance(ground, PrescribedSlip):
        eta = np.tile([ground.eta_left_ratio, ground.eta_right_ratio], (len(time_s), 1))
    return ObservedRun(run, observe(observer, time_s, rows), rows, pose, eta)


def constant_speeds(motion: TrackMotion, duration_s: float) -> Array:
    """Return commands (n, 2) of a motion."""
    return np.tile(motion.speed_mps, (round(duration_s * COMMANDS_HZ) + 1, 1))


def observed_motion(
    motion: TrackMotion,
    seed: int | np.random.SeedSequence,
    duration_s: float = 60.0,
    settings: TrackedSettings = PAPER,
    sensors: TrackedSensors = NOISY,
) -> ObservedRun:
    """Observe a motion with its constant efficiencies."""
    speeds = constant_speeds(motion, duration_s)
    return observed(PrescribedSlip(*motion.eta_ratio), speeds, seed, settings, sensors)


def seeds(trial: Trial) -> list[np.random.SeedSequence]:
    """Return the seeds of several runs."""
    return np.random.SeedSequence(trial.seed).spawn(FEW_RUNS if trial.quick else RUNS)


def converged_s(run: ObservedRun, ratio: float) -> float:
    """Return from when on both efficiencies are within a ratio of the true ones; NaN if not at the end."""
    far = np.flatnonzero((np.abs(run.estimate - run.eta) > ratio * np.abs(run.eta)).any(axis=1))
    if not len(far):
        return 0.0
    return float(run.time_s[far[-1] + 1]) if far[-1] + 1 < len(run.time_s) else float("nan")


def rms(values: Array) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def side_by_side(title: str, y_label: str, panels: Sequence[Sequence[Mark | Mark]]) -> Figure:
    """Return a figure over time of both motions."""
    return Figure(title, tuple(Panel(tuple(marks), y_label) for marks in panels), x_label="time [s]")


# -- V: a circle and a straight run, with raw fixes (figures 3 to 5) ------------------------------------------------

TURN_S = 159.0
"""Time of a whole turn on the circle, and what it takes to start."""


def two_motions(trial: Trial) -> Finding:
    """Observe both motions with the gains of the paper."""
    duration_s = TURN_S / 3.0 if trial.quick else TURN_S
    position, efficiencies, first = [], [], {}
    for name, motion in MOTIONS.items():
        runs = [observed_motion(motion, each, duration_s) for each in seeds(trial)]
        first[name] = runs[0]
        late = [run.time_s > SETTLED_S for run in runs]
        off_m = [rms((run.track.mean[:, :2] - run.pose[:, :2])[k]) for run, k in zip(runs, late, strict=True)]
        off_eta = [rms((run.estimate - run.eta)[k]) for run, k in zip(runs, late, strict=True)]
        scatter = float(np.mean([rms((by_15(run) - run.eta)[k]) for run, k in zip(runs, late, strict=True)]))
        from_15 = [
            rms(np.mean((run.estimate - by_15(run))[k], axis=0)) for run, k in zip(runs, late, strict=True)
        ]
        beside = {
            "standard deviation stated by the observer": float(
                np.mean([run.track.std[-1, 5:7] for run in runs])
            ),
            "scatter of (15)": scatter,
            "mean difference to (15)": float(np.mean(from_15)),
        }
        n_fixes = float(np.sum(np.isfinite(runs[0].rows[late[0], 2])))
        position.append(Numbers.over(off_m))
        efficiencies.append(
            Numbers.over(off_eta, beside, from_15=max(from_15), scatter=scatter, n_fixes=n_fixes)
        )
    figures = {
        "positions": Figure(
            "Positions",
            tuple(
                Panel(
                    (
                        Line("raw fixes", *run.run.streams["gnss"].values[:, :2].T, 5),
                        Line("observer", *run.track.mean[:, :2].T, 0),
                    ),
                    "y [m]",
                    equal=name == "circle",
                )
                for name, run in first.items()
            ),
            x_label="x [m]",
        ),
        "errors": side_by_side(
            "Measured less estimated", "observation error", [_residuals(run) for run in first.values()]
        ),
        "estimates": side_by_side(
            "Efficiencies of the tracks",
            "efficiency",
            [
                [
                    *(
                        Points(f"{side}, by (15)", run.time_s[100:], by_15(run)[100:, k], colour=6)
                        for k, side in _SIDES
                    ),
                    *_efficiencies(run.time_s, run.eta, run.estimate, run.time_s),
                ]
                for run in first.values()
            ],
        ),
    }
    return Finding({"position": position, "efficiencies": efficiencies}, figures)


_SIDES = ((0, "left"), (1, "right"))


def _residuals(run: ObservedRun) -> list[Mark]:
    fixed = np.isfinite(run.rows[:, 2:5]).all(axis=1)
    error = run.rows[fixed, 2:5] - run.track.mean[fixed, :3]
    error[:, 2] = wrapped(error[:, 2])
    names = ("x [m]", "y [m]", "heading [rad]")
    return [Line(name, run.time_s[fixed], error[:, k]) for k, name in enumerate(names)]


def _efficiencies(true_s: Array, true: Array, estimate: Array, time_s: Array) -> list[Mark]:
    marks = [Line(f"{side}, true", true_s, true[:, k], 6, dashed=True) for k, side in _SIDES]
    return [*marks, Line("left", time_s, estimate[:, 0], 0), Line("right", time_s, estimate[:, 1], 5)]


def by_15(run: ObservedRun) -> Array:
    """Return the efficiencies (n, 2) by (15), at the ticks, from the speeds of the last fix and the gyro."""
    gnss, time_s = run.run.streams["gnss"], run.time_s
    yaw = run.run.streams["compass"].channel("yaw_rad")
    speed = gnss.channel("velocity_x_mps") * np.cos(yaw) + gnss.channel("velocity_y_mps") * np.sin(yaw)
    last = np.maximum(np.searchsorted(gnss.time_s, time_s + 1e-6) - 1, 0)
    left, right = run.rows[:, 0], run.rows[:, 1]
    return measured_efficiency(speed[last], run.rows[:, 5], left, right, orchard_ugv().half_track_m)


# -- V: how long the efficiencies take to converge, by speed and gains ----------------------------------------------


def convergence(trial: Trial) -> Finding:
    """Observe straight motion at three speeds, without noise, and with noise for the price of a gain."""
    speeds = [claim["speed"] for claim in trial.each["identity"]]
    motions = [STRAIGHT._replace(speed_mps=(speed, speed)) for speed in speeds]
    paper, normalised = (
        [observed_motion(motion, trial.seed, settings=settings, sensors=QUIET) for motion in motions]
        for settings in (PAPER, NORMALISED)
    )
    circle = observed_motion(CIRCLE, trial.seed, sensors=QUIET)
    slowest = max(converged_s(run, CONVERGED_RATIO[0]) for run in normalised)
    least = min(converged_s(run, CONVERGED_RATIO[0]) for run in paper)

    def time(run: ObservedRun) -> Numbers:
        within_5, within_2 = (converged_s(run, ratio) for ratio in CONVERGED_RATIO)
        return Numbers(
            within_5, beside={"within 2 %": within_2}, values={"slowest": slowest, "least_identity": least}
        )

    noise = []
    for claim in trial.each["noise"]:
        errors = []
        for settings in (PAPER, NORMALISED):
            runs = [
                observed_motion(MOTIONS[claim["motion"]], each, settings=settings) for each in seeds(trial)
            ]
            off = [rms((run.estimate - run.eta)[run.time_s > SETTLED_S]) for run in runs]
            errors.append(float(np.mean(off)))
        noise.append(Numbers(errors[0], beside={"normalised gain": errors[1]}))
    numbers = {
        "identity": [time(run) for run in paper],
        "circle": time(circle),
        "normalised": [time(run) for run in normalised],
        "noise": noise,
    }
    lines = [
        Line("L and Λ the identity", paper[0].time_s, paper[0].estimate[:, 0], 0),
        Line("normalised, L = 2", normalised[0].time_s, normalised[0].estimate[:, 0], 5),
    ]
    return Finding(numbers, {"convergence": side_by_side("Convergence at 0.3 m/s", "efficiency", [lines])})


# -- IV: equations that are printed wrong: (11), V above (13), and (9) without wrapping -----------------------------

ERRORS_S = 60.0
UNEVEN_PS = np.array([0.2, 0.2, 5.0])
"""Diagonal of an L that is not the identity, far from it so that the growth shows."""


def misprints(trial: Trial) -> Finding:
    """Integrate the error system (10) in straight motion with the printed and with the right equations."""
    right = regressor(0.0, *STRAIGHT.speed_mps, orchard_ugv().half_track_m)
    printed = np.column_stack([np.abs(right[:, 1]) * [1, 0, 1], -np.abs(right[:, 0]) * [1, 0, 1]])
    start = np.r_[np.zeros(3), 1.0 - np.array(STRAIGHT.eta_ratio)]
    frozen, converged = (_errors(m, np.ones(3), start) for m in (printed, right))
    wave = _errors(right, UNEVEN_PS, np.array([0.3, 0.0, 0.05, 0.0, 0.0]))
    v_printed = 0.5 * (np.sum(wave[:, :3] ** 2 / UNEVEN_PS, axis=1) + np.sum(wave[:, 3:] ** 2, axis=1))
    ranks = [float(np.linalg.matrix_rank(m)) for m in (printed, right)]
    beside = {
        "with (11) as printed": float(np.abs(frozen[-1, 3:]).max()),
        "rank as printed": ranks[0],
        "rank": ranks[1],
    }
    numbers = {
        "regressor": Numbers(
            float(np.abs(converged[-1, 3:]).max()),
            beside=beside,
            values={"duration": ERRORS_S, "start": start[3]},
        ),
        "lyapunov": Numbers(
            growth(0.5 * np.sum(wave**2, axis=1)),
            beside={"with V as printed": growth(v_printed)},
            values={"as_printed": growth(v_printed)},
        ),
    }
    lines = [
        Line("(11) as printed", _times(), frozen[:, 3], 5),
        Line("corrected", _times(), converged[:, 3], 0),
    ]
    return Finding(numbers, {"regressor": side_by_side("The regressor (11)", "error of efficiency", [lines])})


def growth(values: Array) -> float:
    """Return the largest ratio of a value to one before it, 1 where none is larger.

    Examples
    --------
    >>> growth(np.array([2.0, 1.0, 1.5, 1.0]))
    1.5
    """
    return float(np.max(values / np.minimum.accumulate(values)))


def _times() -> Array:
    return np.linspace(0.0, ERRORS_S, 1201)


def _errors(m: Array, gain_ps: Array, start: Array) -> Array:
    """Return errors (n, 5) of (10), with Lambda the identity, at a constant heading."""
    a = np.block([[-np.diag(gain_ps), -m], [m.T, np.zeros((2, 2))]])
    found = solve_ivp(lambda _, x: a @ x, (0.0, ERRORS_S), start, t_eval=_times(), rtol=1e-9, atol=1e-12)
    return np.asarray(found.y.T)


# -- Remark 1: errors stay in proportion to additive disturbances ---------------------------------------------------

DISTURBED_STEP_S, DISTURBED_S = 0.05, 120.0
SIZE = 0.02
"""Of the disturbance: 2 cm/s, 0.02 rad/s and 0.02 1/s together."""


def disturbances(trial: Trial) -> Finding:
    """Drive the error system with disturbances of a fixed size: constant, random, and the worst there is."""
    largest, figures = [], {}
    for name, motion in MOTIONS.items():
        m = regressor(0.0, *motion.speed_mps, orchard_ugv().half_track_m)
        a = error_matrix(m, np.ones(3), np.eye(2), float(m[2] @ motion.eta_ratio))
        bound, found = disturbance_bound(a), _driven(a, np.random.default_rng(trial.seed), trial.quick)
        time_s = DISTURBED_STEP_S * (1 + np.arange(len(found["constant"])))
        limit = _limit(bound, time_s)
        late = max(float(norms[len(norms) // 2 :].max()) for norms in found.values())
        beside = {
            "bound": bound.disturbance_s * SIZE,
            "error per disturbance by the bound [s]": bound.disturbance_s,
            "rate by the bound [1/s]": bound.rate_ps,
        }
        inside = all(bool((norms <= limit).all()) for norms in found.values())
        largest.append(Numbers(late, beside=beside, values={"size": SIZE, "inside": inside}))
        lines = [Line("bound", time_s, limit), *(Line(kind, time_s, norms) for kind, norms in found.items())]
        figures[name] = side_by_side(f"Remark 1 as a bound, {name}", "norm of the errors", [lines])
    return Finding({"largest": largest}, figures)


def _driven(a: Array, rng: np.random.Generator, quick: bool) -> dict[str, Array]:
    """Return the norms (n,) of the errors, from an error of efficiency of 0.2 at the start."""
    n = round(DISTURBED_S / DISTURBED_STEP_S) // (2 if quick else 1)
    exact = expm(DISTURBED_STEP_S * np.block([[a, np.eye(5)], [np.zeros((5, 10))]]))
    weakest = np.linalg.svd(np.linalg.inv(a))[2][0]
    towards = np.empty((n, 5))
    towards[n - 1] = np.linalg.svd(np.linalg.inv(a))[0][:, 0]
    for k in range(n - 1, 0, -1):
        towards[k - 1] = exact[:5, :5].T @ towards[k]
    forces = {
        "constant": np.tile(weakest, (n, 1)),
        "random": rng.standard_normal((n, 5)),
        "worst at the end": towards,
    }
    found = {}
    for name, force in forces.items():
        x, norms = np.array([0.0, 0.0, 0.0, 0.2, 0.2]), np.empty(n)
        for k in range(n):
            unit = force[k] / max(float(np.linalg.norm(force[k])), 1e-300)
            x = exact[:5, :5] @ x + exact[:5, 5:] @ (SIZE * unit)
            norms[k] = np.linalg.norm(x)
        found[name] = norms
    return found


def _limit(bound: ErrorBound, time_s: Array) -> Array:
    decayed = bound.overshoot_ratio * np.exp(-bound.rate_ps * time_s) * np.hypot(0.2, 0.2)
    return np.asarray(decayed + bound.disturbance_s * SIZE)


# -- Assumption 1 and (7): slip by the forces under the tracks, on homogeneous soil ---------------------------------


def on_soils(trial: Trial) -> Finding:
    """Drive both motions at constant speeds on a soil, where the slip is that of the forces."""
    soil = load_soil("grass")
    change, sideways, error, panels = [], [], [], []
    for motion in MOTIONS.values():
        run = observed(soil, constant_speeds(motion, 60.0 if trial.quick else 120.0), trial.seed)
        exact = observed(soil, constant_speeds(motion, 60.0), trial.seed, sensors=QUIET)
        steady = exact.eta[exact.time_s > 10.0]
        off = run.estimate[run.time_s > SETTLED_S] - np.mean(steady, axis=0)
        sides = {"left": float(steady[-1, 0]), "right": float(steady[-1, 1])}
        change.append(Numbers(float(np.ptp(steady, axis=0).max()), beside=sides))
        sideways.append(Numbers(float(exact.run.streams["truth"].channel("speed_y_mps")[-1])))
        means = {f"mean error, {side}": float(off[:, k].mean()) for k, side in _SIDES}
        error.append(Numbers(rms(off), beside=means))
        panels.append(_efficiencies(exact.time_s[50:], exact.eta[50:], run.estimate, run.time_s))
    figure = side_by_side("Efficiencies on grass", "efficiency", panels)
    numbers = {"change": change, "sideways": sideways, "error": error, "inverse": _inverse(soil, exact)}
    return Finding(numbers, {"efficiencies": figure})


def _inverse(soil: Soil, run: ObservedRun) -> Numbers:
    """Return the slip in straight motion by inverting (7) for the resistance of a track."""
    robot = orchard_ugv()
    tracks = tracks_on(robot, soil)[0]
    load_n = 0.5 * robot.mass_kg * GRAVITY_MPS2
    resistance_n = tracks["rolling_ratio"] * load_n
    if tracks["kphi_npmn2"] > 0.0:
        modulus = tracks["kc_npmn1"] + tracks["width_m"] * tracks["kphi_npmn2"]
        resistance_n += compaction_resistance(rut_depth(tracks, load_n), modulus, tracks["exponent_ratio"])
    area_m2 = robot.contact_length_m * robot.track_width_m
    limit_n = friction_limit(load_n, area_m2, tracks["cohesion_pa"], tracks["tan_friction"])
    slip = float(janosi_slip(resistance_n, limit_n, robot.contact_length_m, soil.shear_modulus_m))
    vehicle = float(np.mean(1.0 - run.eta[-1]))
    return Numbers(slip, beside={"simulated vehicle": vehicle}, values={"vehicle": vehicle})


# -- I: where the trees of an orchard hide the satellites, and at rest ----------------------------------------------

LOST_S, STAND_S = (40.0, 50.0), (60.0, 660.0)


def missing_fixes(trial: Trial) -> Finding:
    """Lose the fixes for 10 s on the circle, and stand for 10 minutes after a straight run."""
    speeds, slip = constant_speeds(CIRCLE, 80.0), PrescribedSlip(*CIRCLE.eta_ratio)
    lost = [observed(slip, speeds, each, lost_s=LOST_S) for each in seeds(trial)]
    off_m, stated_m, resets = [], [], 0
    for run in lost:
        k = int(np.searchsorted(run.time_s, LOST_S[1] - 0.01)) - 1
        off_m.append(float(np.hypot(*(run.track.mean[k, :2] - run.pose[k, :2]))))
        stated_m.append(float(np.hypot(*run.track.std[k, :2])))
        resets += int(np.sum(run.track.status == ObserverStatus.RESET))
    beside = {"standard deviation stated by the observer": float(np.mean(stated_m))}
    stop = constant_speeds(STRAIGHT, STAND_S[1] / (5.0 if trial.quick else 1.0))
    stop[np.arange(len(stop)) * 0.02 >= STAND_S[0]] = 0.0
    stood = observed(PrescribedSlip(*STRAIGHT.eta_ratio), stop, trial.seed)
    longest_s = PAPER.longest_interval_s
    numbers = {
        "lost": Numbers.over(off_m, beside, resets=resets, n_runs=len(lost), longest=longest_s),
        "rest": _standing(stood),
    }
    run = lost[0]
    shown = (run.time_s > LOST_S[0] - 10.0) & (run.time_s < LOST_S[1] + 10.0)
    off, std = (run.track.mean[:, :2] - run.pose[:, :2])[shown], run.track.std[shown, :2]
    lines = [
        Line("error of the position", run.time_s[shown], np.hypot(*off.T), 0),
        Line("2 std, stated", run.time_s[shown], 2.0 * np.hypot(*std.T), 5),
    ]
    title = "Dead reckoning with the estimated efficiencies"
    return Finding(numbers, {"lost": side_by_side(title, "position error [m]", [lines])})


def _standing(run: ObservedRun) -> Numbers:
    standing = np.flatnonzero(run.track.status == ObserverStatus.STANDING)
    standing = standing[run.time_s[standing] > STAND_S[0] + 1.0]
    change = np.abs(run.track.slip[standing] - run.track.slip[standing[0]]).max()
    off_m = np.hypot(*(run.track.mean[standing, :2] - run.pose[standing, :2]).T)
    minutes = (run.time_s[standing[-1]] - run.time_s[standing[0]]) / 60.0
    beside = {"largest position error [m]": float(off_m.max())}
    return Numbers(float(change), beside=beside, values={"minutes": minutes})


# -- VI, future work: the observer in the loop of a controller that compensates slip --------------------------------

DESIRED = (0.5, 0.15)
"""Forward speed in m/s and turning speed in rad/s."""
LOOP_S, LOOP_SETTLED_S = 60.0, 15.0
SOILS, FIRST_M = ("grass", "dry_sand"), 10.0
"""The soil changes after a distance; on both a turn needs much of the friction."""
TICK_S, FIX_TICKS = 0.02, 5


class ClosedLoop(NamedTuple):
    """Forward and turning speed (n, 2) at the ticks (n,), and the efficiencies (n, 2) that were used."""

    time_s: Array
    speed: Array
    eta: Array


def compensation(trial: Trial) -> Finding:
    """Drive a turn over a change of soil, with and without the estimated efficiencies."""
    duration_s = LOOP_S / (2.0 if trial.quick else 1.0)
    runs = {
        label: [closed_loop(each, duration_s, label == "compensated") for each in seeds(trial)]
        for label in ("compensated", "plain")
    }

    def off(label: str, which: int) -> list[float]:
        return [rms(one.speed[one.time_s > LOOP_SETTLED_S, which] - DESIRED[which]) for one in runs[label]]

    speed = [
        Numbers.over(
            off("compensated", k),
            {"without compensation": float(np.mean(off("plain", k)))},
            desired=DESIRED[k],
        )
        for k in (0, 1)
    ]
    panels = []
    for k, label in enumerate(("forward speed [m/s]", "turning speed [rad/s]")):
        lines = [Line(name, row[0].time_s, row[0].speed[:, k]) for name, row in runs.items()]
        time_s = runs["plain"][0].time_s
        desired = Line("desired", time_s, np.full(len(time_s), DESIRED[k]), 6, dashed=True)
        panels.append(Panel((*lines, desired), label))
    title = "Desired speeds are held by compensating the slip"
    return Finding({"speed": speed}, {"compensation": Figure(title, tuple(panels), x_label="time [s]")})


def closed_loop(seed: np.random.SeedSequence, duration_s: float, compensated: bool) -> ClosedLoop:
    """Return what a vehicle does whose tracks follow the commands with a lag, on two soils.

    Parameters
    ----------
    seed : of the noise of fixes, compass and gyro
    duration_s : of the run
    compensated : whether the estimated efficiencies are used; else they are taken for 1
    """
    robot, rng = orchard_ugv(), np.random.default_rng(seed)
    grounds = zip(SOILS, (FIRST_M, np.inf), strict=True)
    tracks = np.concatenate([tracks_on(robot, load_soil(name), until_m) for name, until_m in grounds])
    settings, observer = TrackSpeedSettings(), TrackedObserver(robot, NORMALISED)
    used, state, belts = np.ones(2), np.zeros(2, STATE), np.zeros(2)
    known, unknown = (np.ones(2), np.full(2, NORMALISED.eta_std_ratio)), (np.ones(2), np.zeros(2))
    noise = np.array([NOISY.gnss_m, NOISY.gnss_m, NOISY.compass_rad])
    keep, n = np.exp(-STEP_S / NOISY.belt_lag_s), round(duration_s / TICK_S)
    speed, etas = np.empty((n, 2)), np.empty((n, 2))
    for k in range(n):
        command = track_speed_step(
            robot, settings, used, DESIRED, *(known if compensated else unknown), TICK_S
        )
        used = command.eta
        for _ in range(round(TICK_S / STEP_S)):
            belts = keep * belts + (1.0 - keep) * np.array([command.left_mps, command.right_mps])
            drive_tracks(tracks, np.array(LEVEL), np.array([belts, belts]), state, STEP_S)
            state[0] = state[1]
        row = np.full(6, np.nan)
        row[:2] = belts + NOISY.encoder_mps * rng.standard_normal(2)
        row[5] = state["yaw_rate_radps"][0] + NOISY.gyro_radps * rng.standard_normal()
        if k % FIX_TICKS == 0:
            row[2:5] = state[["position_x_m", "position_y_m", "yaw_rad"]][0].tolist()
            row[2:5] += noise * rng.standard_normal(3)
        output = observer.step(row, TICK_S)
        known = output.mean[5:7], output.std[5:7]
        speed[k], etas[k] = state[["speed_x_mps", "yaw_rate_radps"]][0].tolist(), used
    return ClosedLoop(TICK_S * np.arange(1, n + 1), speed, etas)
