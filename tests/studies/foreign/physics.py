"""A simulator of wheeled robots of its own: forces of tyres on a rigid body, integrated by Runge and Kutta.

It shares no equation with the package, so that it can examine it.  All runs of a set are integrated at once, as rows
of arrays; wheels turn and steer as given, and the body follows by what its contacts pull.

A body of mass m and yaw inertia I moves with the twist (v_x, v_y, w) of its centre of mass::

    m (dv_x/dt - w v_y) = sum F_x - m g s_x,    m (dv_y/dt + w v_x) = sum F_y - m g s_y,    I dw/dt = sum x F_y - y F_x

on a slope of (s_x, s_y) in the body's axes.  Loads of the wheels follow from the moments about the ground, by the
accelerations behind the first-order lag of a suspension; with four wheels they are those of least norm.

**Tyres of skid-steer and swerve robots** are isotropic brushes (Pacejka, Tire and Vehicle Dynamics, 3.3): with the
slip vector ``s = (velocity of the contact) / max(|r omega|, v_0)`` and ``z = c |s| / 3 mu``::

    |F| = mu N (3 z - 3 z^2 + z^3) where z < 1, else mu N

against the slip.  **Tyres of the car** have the magic formula ``mu N sin(C arctan(B s))`` along and across, the one
across scaled by what the friction ellipse leaves; its driven wheels share their force by an open differential, its
front wheels roll freely.  **Omni wheels** pull along their plane as a brush; their rollers resist across it by a
friction that grows to a bound.  Soft ground takes a drag of each wheel that is moved along its plane.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from terrain.records import Array

G_MPS2 = 9.80665
STEP_S = 0.0025  #: of the integration: contacts at rest settle within some milliseconds
EVERY = 4  #: steps between samples of the motion
SAMPLE_S = STEP_S * EVERY
SUSPENSION_S = 0.08  #: lag by which loads follow accelerations
CREEP_MPS = 0.25  #: v_0, below which a contact is viscous
TREAD_MPS = 0.02  #: sliding speed over which a directional tread turns its grip
SHAPE = 1.4  #: C of the magic formula
SOFTER_RATIO = 0.25  #: loss of a car tyre's stiffness over its load, for a load that doubles


class Body(NamedTuple):
    """A robot as it is, whatever its description says."""

    law: str  #: of its contacts: brush, magic or rollers
    wheels_m: Array  #: (wheels, 2) from the middle of the body
    radius_m: Array  #: (wheels,) of the tyres
    mass_kg: float
    inertia_kgm2: float
    com_m: tuple[float, float] = (0.0, 0.0)
    com_height_m: float = 0.2
    friction_ratio: float = 0.7  #: mu
    stiffness_ratio: float = 10.0  #: force over load for a slip, at its start
    cornering_ratio: float = 1.0  #: stiffness of a car's tyres across over that along
    drag_ratio: float = 0.04  #: of soft ground, over the load
    roller_ratio: float = 0.03  #: friction of rollers over the load
    driven: tuple[bool, ...] = ()  #: wheels that are driven; all of them where none is named
    #: loss of radius for a load that doubles
    squash_ratio: float = 0.0
    #: amplitude of the radius over the angle of a wheel
    eccentricity_ratio: float = 0.0
    #: by how much more a tread grips across when it slides to one side
    tread_ratio: float = 0.0
    wind_n: tuple[float, float] = (0.0, 0.0)  #: force east and north


class Motion(NamedTuple):
    """Samples (n, runs) of the middle of the body, and (n, runs, wheels) of its wheels."""

    time_s: Array
    speed_x_mps: Array
    speed_y_mps: Array
    yaw_rate_radps: Array
    yaw_rad: Array
    accel_x_mps2: Array  #: specific force at the middle, as an accelerometer has it
    accel_y_mps2: Array
    slope_x: Array  #: tangent of the slope along and to the left
    slope_y: Array
    pull_n: Array  #: of each wheel along its plane
    load_n: Array
    seen_x_mps: Array | None = (
        None  #: speeds of a lidar in its axes, and its place east and north, where it is
    )
    seen_y_mps: Array | None = None  #: part of the motion
    seen_m: Array | None = None


def brush(z: Array) -> Array:
    """Return force over its bound for a slip over that of full sliding."""
    z = np.minimum(z, 1.0)
    return np.asarray(z * (3.0 - z * (3.0 - z)))


def magic(slip: Array, stiffness: Array | float, friction: float) -> Array:
    """Return force over load by the magic formula, of the slope ``stiffness`` at 0 and the peak ``friction``."""
    return np.asarray(friction * np.sin(SHAPE * np.arctan(stiffness / (SHAPE * friction) * slip)))


class Plant:
    """Bodies on their wheels: the derivative of their state."""

    def __init__(self, body: Body, slope: Array, friction: Array) -> None:
        self.body, self.slope, self.friction = body, slope, friction[:, None]
        self.at = body.wheels_m - np.array(body.com_m)
        self.driven = np.array(body.driven or (True,) * len(self.at))
        levers = np.vstack([np.ones(len(self.at)), self.at.T])
        self.spread = np.linalg.pinv(levers)  # (wheels, 3)
        self.static = self.spread[:, 0] * body.mass_kg * G_MPS2
        # lugs that bite when front and rear slide apart to one side
        self.tread = np.where(self.at[:, 0] >= 0.0, 1.0, -1.0)

    def loads(self, pushed: Array) -> Array:
        """Return loads (runs, wheels) under specific forces (runs, 2)."""
        h, weight = self.body.com_height_m, self.body.mass_kg * G_MPS2
        moved = -h / G_MPS2 * pushed
        load = weight * (self.spread[:, 0] + moved @ self.spread[:, 1:].T)
        return np.asarray(np.maximum(load, 0.02 * weight))

    def forces(
        self, twist: Array, pushed: Array, rate: Array, steer: Array, turned: Array
    ) -> tuple[Array, ...]:
        """Return forces (runs, wheels) along and across the planes of the wheels, and loads."""
        body, load = self.body, self.loads(pushed)
        radius = body.radius_m * (1.0 - body.squash_ratio * (load / self.static - 1.0))
        if body.eccentricity_ratio:
            phase = np.arange(len(self.at)) * 2.4
            radius = radius * (1.0 + body.eccentricity_ratio * np.sin(turned + phase))
        circumferential_mps = radius * rate
        v_x = twist[:, :1] - twist[:, 2:3] * self.at[:, 1]
        v_y = twist[:, 1:2] + twist[:, 2:3] * self.at[:, 0]
        cos, sin = np.cos(steer), np.sin(steer)
        along, across = v_x * cos + v_y * sin, v_y * cos - v_x * sin
        grip, stiff = body.friction_ratio * self.friction, body.stiffness_ratio
        uneven = (
            1.0 + body.tread_ratio * np.tanh(across * self.tread / TREAD_MPS) if body.tread_ratio else 1.0
        )
        drag = body.drag_ratio * load * np.tanh(along / 0.02)
        if body.law == "magic":
            mean = np.where(self.driven, along - circumferential_mps, 0.0).sum(axis=1) / self.driven.sum()
            v = np.maximum(np.abs(along), 2.0 * CREEP_MPS)
            own = -magic(mean[:, None] / v, stiff, body.friction_ratio) * self.friction
            pull = np.where(self.driven, own * load[:, self.driven].mean(axis=1, keepdims=True), 0.0)
            left = np.sqrt(np.maximum(1.0 - (pull / (grip * load)) ** 2, 0.04))
            softer = body.cornering_ratio * stiff * (1.0 - SOFTER_RATIO * (load / self.static - 1.0))
            side = -magic(across / v, softer, body.friction_ratio) * self.friction
            return pull - drag, side * load * left * uneven, load, pull
        reach = np.maximum(np.abs(circumferential_mps), CREEP_MPS)
        if body.law == "rollers":
            slip = (along - circumferential_mps) / reach
            z = stiff * np.abs(slip) / (3.0 * grip)
            pull = -grip * load * brush(z) * np.sign(slip)
            fastest = np.maximum(np.abs(rate * radius).max(axis=1, keepdims=True), 0.05)
            side = -body.roller_ratio * load * np.tanh(2.0 * across / fastest)
            return pull - drag, side, load, pull
        s_x, s_y = (along - circumferential_mps) / reach, across / reach
        size = np.maximum(np.hypot(s_x, s_y), 1e-9)
        force = grip * load * brush(stiff * size / (3.0 * grip)) / size
        pull = -force * s_x
        return pull - drag, -force * s_y * uneven, load, pull

    def derivative(self, state: Array, rate: Array, steer: Array, turned: Array) -> tuple[Array, ...]:
        """Return that of (v_x, v_y, w, yaw, lagged specific forces), with pulls and loads."""
        body = self.body
        force_x, force_y, load, pull = self.forces(state[:, :3], state[:, 4:6], rate, steer, turned)
        cos, sin = np.cos(steer), np.sin(steer)
        f_x, f_y = force_x * cos - force_y * sin, force_x * sin + force_y * cos
        head = np.column_stack([np.cos(state[:, 3]), np.sin(state[:, 3])])
        east, north = body.wind_n
        blown_x = east * head[:, 0] + north * head[:, 1]
        blown_y = north * head[:, 0] - east * head[:, 1]
        push_x = (f_x.sum(axis=1) + blown_x) / body.mass_kg
        push_y = (f_y.sum(axis=1) + blown_y) / body.mass_kg
        tilt_x, tilt_y = slopes_of(self.slope, state[:, 3])
        out = np.empty_like(state)
        out[:, 0] = push_x - G_MPS2 * tilt_x + state[:, 2] * state[:, 1]
        out[:, 1] = push_y - G_MPS2 * tilt_y - state[:, 2] * state[:, 0]
        out[:, 2] = (self.at[:, 0] * f_y - self.at[:, 1] * f_x).sum(axis=1) / body.inertia_kgm2
        out[:, 3] = state[:, 2]
        out[:, 4] = (push_x - state[:, 4]) / SUSPENSION_S
        out[:, 5] = (push_y - state[:, 5]) / SUSPENSION_S
        return out, pull, load


def slopes_of(slope: Array, yaw: Array) -> tuple[Array, Array]:
    """Return slopes (...,) along a heading and to its left, of slopes (runs, 2) east and north."""
    cos, sin = np.cos(yaw), np.sin(yaw)
    return slope[:, 0] * cos + slope[:, 1] * sin, slope[:, 1] * cos - slope[:, 0] * sin


def integrate(body: Body, rate: Array, steer: Array, slope: Array, friction: Array, yaw_rad: Array) -> Motion:
    """Return the motion of bodies from rest.

    Parameters
    ----------
    rate, steer : (2 n + 1, runs, wheels) of the wheels every half step, rad/s and rad
    slope : (runs, 2) east and north
    friction : (runs,) over the body's own
    yaw_rad : (runs,) headings at the start
    """
    plant = Plant(body, slope, friction)
    n, runs = (len(rate) - 1) // 2, rate.shape[1]
    turned = np.cumsum(rate, axis=0) * (0.5 * STEP_S)
    state = np.zeros((runs, 6))
    state[:, 3] = yaw_rad
    kept, step = [], STEP_S
    for k in range(n + 1):
        at = 2 * k
        first, pull, load = plant.derivative(state, rate[at], steer[at], turned[at])
        if k % EVERY == 0:
            kept.append((state, first, pull, load))
        if k == n:
            break
        mid = rate[at + 1], steer[at + 1], turned[at + 1]
        second = plant.derivative(state + 0.5 * step * first, *mid)[0]
        third = plant.derivative(state + 0.5 * step * second, *mid)[0]
        last = plant.derivative(state + step * third, rate[at + 2], steer[at + 2], turned[at + 2])[0]
        state = state + step / 6.0 * (first + 2.0 * (second + third) + last)
    states, rates, pulls, loads = (np.array(each) for each in zip(*kept, strict=True))
    v_x, v_y, w, yaw = (states[..., i] for i in range(4))
    tilt = slopes_of(slope, yaw)
    c_x, c_y = body.com_m
    # from the centre of mass to the middle of the body
    return Motion(
        time_s=np.arange(len(states)) * SAMPLE_S,
        speed_x_mps=v_x + w * c_y,
        speed_y_mps=v_y - w * c_x,
        yaw_rate_radps=w,
        yaw_rad=yaw,
        accel_x_mps2=rates[..., 0] - w * v_y + G_MPS2 * tilt[0] + rates[..., 2] * c_y + w**2 * c_x,
        accel_y_mps2=rates[..., 1] + w * v_x + G_MPS2 * tilt[1] - rates[..., 2] * c_x + w**2 * c_y,
        slope_x=tilt[0],
        slope_y=tilt[1],
        pull_n=pulls,
        load_n=loads,
    )
