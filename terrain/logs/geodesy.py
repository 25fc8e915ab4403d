"""Positions of satellite receivers in metres: east, north and up of an origin."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from terrain.errors import LogError, library
from terrain.records import Array


def local_metres(
    latitude_rad: Array, longitude_rad: Array, height_m: Array | None = None, origin: Sequence[float] = ()
) -> Array:
    """Return positions (n, 3) in m, east, north and up, by the ellipsoid WGS 84; NaN where one is unknown.

    Parameters
    ----------
    latitude_rad, longitude_rad : (n,) geodetic
    height_m : (n,) above the ellipsoid; that of the origin where it is not known
    origin : its latitude and longitude in rad, and its height in m; the first known position by default

    Raises
    ------
    LogError
        if no position is known, or a latitude is beyond a pole.
    ConfigError
        if pymap3d is not installed.

    Examples
    --------
    >>> local_metres(np.radians([45.0, 45.001]), np.radians([7.0, 7.0]))[1, 1].round(2)
    np.float64(111.13)
    """
    pymap3d = library("pymap3d", "latitude and longitude need the package pymap3d", "logs")
    known = np.isfinite(latitude_rad) & np.isfinite(longitude_rad)
    if not known.any():
        raise LogError("no latitude and longitude are known")
    if np.abs(latitude_rad[known]).max() > np.pi / 2:
        raise LogError(
            f"latitude reaches {np.degrees(np.abs(latitude_rad[known]).max()):g} deg, 90 is the most"
        )
    if not origin:
        first = int(np.flatnonzero(known)[0])
        base_m = 0.0 if height_m is None or not np.isfinite(height_m[first]) else float(height_m[first])
        origin = (float(latitude_rad[first]), float(longitude_rad[first]), base_m)
    heights_m = np.full(latitude_rad.shape, origin[2]) if height_m is None else height_m
    heights_m = np.where(np.isfinite(heights_m), heights_m, origin[2])
    enu_m = pymap3d.geodetic2enu(latitude_rad, longitude_rad, heights_m, *origin, deg=False)
    east_north_up: Array = np.column_stack(enu_m)
    east_north_up[~known] = np.nan
    return east_north_up
