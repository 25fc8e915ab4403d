"""Paths to follow: points or curvature along the distance, and where on a path a robot is.

A path is a table on a uniform grid of distance s: position, heading, curvature c and side slope.  From
points it is a smoothing spline of the fifth degree, whose curvature is continuous; points that repeat are
merged and counted.  The place of a robot is searched next to where it was, and does not go back (Deremetz et
al. 2017, Fig. 1: M is the point of the path closest to R); beyond the end it is the end, with a status.

Files of paths: CSV with a header, or two columns of numbers.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import splev, splprep

from terrain.angles import unwrapped, wrapped
from terrain.errors import DataError, LogError
from terrain.files.names import MEBIBYTE, read_regular
from terrain.records import Array, read_only
from terrain.status import StatusCode

GRID_M = 0.05  #: Distance between the rows of a path.
_MERGED_M = 1e-3
_LONGEST_M = 50_000.0


class PathStatus(StatusCode):
    """Where a robot is beside a path."""

    OK = 0
    END = 1  #: At or beyond the end.
    FAR = 2  #: Further from the path than the search reaches: the place is as it was.
    SINGULAR = 3  #: Near the centre of curvature, 1 - c y close to 0 or below.
    NO_POSE = 4  #: The pose is not known: the place is as it was.


class Place(NamedTuple):
    """Where a robot is on a path."""

    distance_m: float  #: s of the closest point
    lateral_m: float  #: y, of the robot to the left of the path
    angle_rad: float  #: theta~, heading of the robot less that of the path
    curvature_pm: float  #: c(s)
    status: PathStatus


_WINDOW_M = 3.0
_REACH_M = 5.0
_AS_NEAR_M = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class ReferencePath:
    """A path, at distances that rise by :data:`GRID_M` from 0."""

    x_m: Array  #: (n,)
    y_m: Array
    heading_rad: Array
    curvature_pm: Array
    #: (n,) side slope, left side up > 0; NaN where it is not known, as without any
    roll_rad: Array | None = None
    n_merged: int = 0  #: points that repeated the one before

    def __post_init__(self) -> None:
        if self.roll_rad is None:
            object.__setattr__(self, "roll_rad", np.full(len(self.x_m), np.nan))
        for name in ("x_m", "y_m", "heading_rad", "curvature_pm", "roll_rad"):
            object.__setattr__(self, name, read_only(getattr(self, name)))

    @property
    def distance_m(self) -> Array:
        """Distances (n,) along the path."""
        return np.arange(len(self.x_m)) * GRID_M

    @property
    def length_m(self) -> float:
        """Distance from its start to its end."""
        return (len(self.x_m) - 1) * GRID_M

    @property
    def start(self) -> tuple[float, float, float]:
        """Pose at its start."""
        return float(self.x_m[0]), float(self.y_m[0]), float(self.heading_rad[0])

    def roll_at(self, row: int, roll_rad: float) -> float:
        """Return the side slope at a row; where it is not known, the one given."""
        assert self.roll_rad is not None
        known = float(self.roll_rad[row])
        return roll_rad if math.isnan(known) else known

    def row_at(self, distance_m: float) -> int:
        """Return the number of the last row before a distance."""
        return min(max(int(distance_m / GRID_M), 0), len(self.x_m) - 1)

    def locate(self, x_m: float, y_m: float, yaw_rad: float, before_m: float = math.nan) -> Place:
        """Return where a robot is.

        Parameters
        ----------
        x_m, y_m, yaw_rad : pose of the robot
        before_m : s at the step before; NaN at first, when all of the path is searched, and of places on a path
            that comes back to itself the first is taken

        Examples
        --------
        >>> ahead = path_from_curvature(np.array([0.0, 20.0]), np.zeros(2))
        >>> place = ahead.locate(3.02, 0.1, 0.0)
        >>> round(place.distance_m, 6), place.lateral_m, place.status.label
        (3.02, 0.1, 'ok')
        """
        is_first, last = math.isnan(before_m), len(self.x_m) - 1
        first = 0 if is_first else self.row_at(before_m)
        if not (abs(x_m) < 1e9 and abs(y_m) < 1e9 and abs(yaw_rad) < 1e6):
            s, curvature = 0.0 if is_first else before_m, float(self.curvature_pm[first])
            return Place(s, math.nan, math.nan, curvature, PathStatus.NO_POSE)
        near = slice(first, (last if is_first else min(first + int(_WINDOW_M / GRID_M), last)) + 1)
        squares = (self.x_m[near] - x_m) ** 2 + (self.y_m[near] - y_m) ** 2
        nearest = int(squares.argmin())
        if (
            is_first
        ):  # the first row, closest among its neighbours, that is hardly further than the closest of all
            away = np.hypot(self.x_m - x_m, self.y_m - y_m)
            closest = (away[:-1] <= away[1:]) & (away[:-1] <= math.sqrt(squares.min()) + _AS_NEAR_M)
            nearest = int(closest.argmax()) if closest.any() else last
        least, nearest = float(squares[nearest]), nearest + first
        heading, curvature = float(self.heading_rad[nearest]), float(self.curvature_pm[nearest])
        off_x, off_y = x_m - float(self.x_m[nearest]), y_m - float(self.y_m[nearest])
        along = math.cos(heading) * off_x + math.sin(heading) * off_y
        lateral = math.cos(heading) * off_y - math.sin(heading) * off_x
        beside = 1.0 - curvature * lateral
        along = min(max(along / max(beside, 0.2), -GRID_M), GRID_M) if nearest < last else along
        s = nearest * GRID_M + along
        s = min(max(s if is_first else max(s, before_m), 0.0), last * GRID_M)
        heading += curvature * (s - nearest * GRID_M)
        status = PathStatus.SINGULAR if beside < 0.2 else PathStatus.OK
        if math.sqrt(least) > _REACH_M:
            status = PathStatus.FAR
        if nearest == last and along >= 0.0:
            status = PathStatus.END
        return Place(s, lateral, float(wrapped(yaw_rad - heading)), curvature, status)


def path_from_curvature(distance_m: Array, curvature_pm: Array) -> ReferencePath:
    """Return the path from (0, 0) along x whose curvature runs linearly between given values.

    Examples
    --------
    >>> circle = path_from_curvature(np.array([0.0, 2 * np.pi * 10]), np.array([0.1, 0.1]))
    >>> bool(np.hypot(circle.x_m[-1], circle.y_m[-1]) < 0.05)
    True
    """
    s = np.arange(0.0, distance_m[-1] + 1e-9, GRID_M)
    curvature = np.interp(s, distance_m, curvature_pm)
    heading = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]))]) * GRID_M
    middle = 0.5 * (heading[1:] + heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle))]) * GRID_M
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle))]) * GRID_M
    return ReferencePath(x, y, heading, curvature)


def path_from_points(points_m: Array, std_m: float = 0.0) -> ReferencePath:
    """Return the path through points, or as near to them as their standard deviation.

    Parameters
    ----------
    points_m : (n, 2) in their order
    std_m : of each coordinate: 0 for points that were computed, the receiver's for points that were driven

    Raises
    ------
    DataError
        if there are fewer than three different points, one is not a finite number, or the path turns back
        at a point.

    Examples
    --------
    >>> angle = np.linspace(0.0, np.pi, 60)
    >>> path = path_from_points(np.column_stack([10 * np.sin(angle), 10 - 10 * np.cos(angle)]))
    >>> round(path.length_m, 1), path.curvature_pm[300].round(3)
    (31.4, np.float64(0.1))
    """
    points = np.asarray(points_m, float)
    if points.ndim != 2 or points.shape[1] != 2:
        raise DataError(f"path: points have shape {points.shape}, (n, 2) is needed")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if bad.size:
        raise DataError(f"path: point {bad[0] + 1} is {points[bad[0]].tolist()}, finite numbers are needed")
    steps = np.hypot(*np.diff(points, axis=0).T)
    kept = points[np.concatenate([[True], steps > _MERGED_M])] if len(points) else points
    if len(kept) < 3:
        raise DataError(f"path: {len(kept)} different points, at least 3 are needed")
    steps = np.hypot(*np.diff(kept, axis=0).T)
    if steps.sum() > _LONGEST_M:
        raise DataError(f"path: {steps.sum():g} m long, at most {_LONGEST_M:g} m are accepted")
    turns = np.abs(wrapped(np.diff(np.arctan2(*np.diff(kept, axis=0).T[::-1]))))
    if turns.max() > 0.75 * np.pi and std_m < 0.25 * steps.min():
        back = int(turns.argmax()) + 1
        raise DataError(
            f"path: turns back by {np.degrees(turns[back - 1]):.0f} degrees at {kept[back].tolist()}"
        )
    along = np.concatenate([[0.0], np.cumsum(steps)])
    spline, _ = splprep(kept.T, u=along, k=min(5, len(kept) - 1), s=2 * len(kept) * std_m**2)
    fine = np.linspace(0.0, along[-1], 1 + max(64, math.ceil(4 * along[-1] / GRID_M)))
    x, y = splev(fine, spline)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.interp(np.arange(0.0, length[-1] + 1e-9, GRID_M), length, fine)
    x, y = splev(at, spline)
    (dx, dy), (ddx, ddy) = splev(at, spline, der=1), splev(at, spline, der=2)
    curvature = (dx * ddy - dy * ddx) / np.maximum(np.hypot(dx, dy), 1e-9) ** 3
    heading = unwrapped(np.arctan2(dy, dx))
    return ReferencePath(x, y, heading, curvature, n_merged=len(points) - len(kept))


_X = ("x_m", "position_x_m", "x")
_Y = ("y_m", "position_y_m", "y")
_MAX_BYTES = 48 * MEBIBYTE
_STEEPEST_RAD = math.radians(45.0)


def read_path(path: Path, std_m: float = 0.0) -> ReferencePath:
    """Read a path.

    Parameters
    ----------
    path : of the file; columns ``x_m`` and ``y_m`` (or ``position_x_m``, ``position_y_m``; or without a
        header the first two), and ``roll_rad`` where the side slope is known
    std_m : standard deviation of the points

    Raises
    ------
    LogError
        if the file cannot be read, has no such columns, or holds something that is no number.
    DataError
        if its points are no path.
    """
    try:
        text = read_regular(path, str(path), LogError, _MAX_BYTES).decode("utf-8-sig")
        separator = ";" if ";" in text.partition("\n")[0] else ","
        cells = list(csv.reader(io.StringIO(text, newline=""), delimiter=separator))
    except (UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{path}: is no CSV file: {error}") from None
    rows = [(number, row) for number, row in enumerate(cells, 1) if any(cell.strip() for cell in row)]
    if not rows:
        raise LogError(f"{path}: is empty")
    names, places = [cell.strip() for cell in rows[0][1]], [0, 1]
    found = [next((names.index(name) for name in known if name in names), None) for known in (_X, _Y)]
    if None not in found:
        places = [place for place in found if place is not None]
        places += [names.index("roll_rad")] if "roll_rad" in names else []
        rows = rows[1:]
    elif not all(map(_is_number, names[:2])):
        raise LogError(f"{path}: columns x_m and y_m are needed, its first row has {', '.join(names[:6])}")
    elif len(names) < 2:
        raise LogError(f"{path}: two columns of numbers are needed, its first row has one")
    values = np.empty((len(rows), len(places)))
    for k, (number, row) in enumerate(rows):
        for j, place in enumerate(places):
            cell = row[place] if place < len(row) else "nothing"
            if not _is_number(cell):
                raise LogError(f"{path}: row {number} has {cell!r}, a number is needed")
            values[k, j] = float(cell)
    try:
        reference = path_from_points(values[:, :2], std_m)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    if len(places) < 3:
        return reference
    points, roll = values[:, :2], values[:, 2]
    if not (np.abs(roll) < _STEEPEST_RAD).all():
        first = int(np.flatnonzero(~(np.abs(roll) < _STEEPEST_RAD))[0]) + 1
        raise DataError(f"{path}: roll_rad is beyond 45 degrees, or no number, at point {first}")
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
    along *= reference.length_m / along[-1]
    return replace(reference, roll_rad=np.interp(reference.distance_m, along, roll))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
