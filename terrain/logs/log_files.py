"""Files of a log and the names in it: neither leads elsewhere, whoever wrote it."""

from __future__ import annotations

from pathlib import Path

from terrain.errors import LogError
from terrain.files.names import check_name, has_control_characters, shown
from terrain.files.regular import check_inside, check_regular
from terrain.records import RunLog


def short_name(path: Path) -> str:
    """Return folder and name of a file, as messages call it: ``ASPHALT/imu_03.csv``."""
    return "/".join(path.parts[-2:])


def check_log_file(path: Path, folder: Path) -> Path:
    """Return a regular file that lies in a folder, links resolved; the folder itself may be a link.

    Raises
    ------
    LogError
        if the file is missing or a link that leads out of the folder, or is no regular file.
    """
    place = short_name(path)
    if not path.is_symlink() and not path.exists():
        raise LogError(f"{place}: is missing")
    check_inside(path, folder, place, LogError)
    check_regular(path, place, LogError)
    return path


def checked_names(place: str, run: RunLog) -> RunLog:
    """Return a run whose names are plain ones: it says nothing of where a file lies.

    Parameters
    ----------
    place : file, as messages name it
    run : run log; a session that is empty is unknown

    Raises
    ------
    LogError
        if a run, robot, session, terrain, stream or channel has no plain name, or what was dropped a name
        with control characters.

    Examples
    --------
    >>> checked_names("run.json", RunLog("SNOW_01", "robots/husky.yaml", {}))
    Traceback (most recent call last):
    terrain.errors.LogError: run.json: robot 'robots/husky.yaml' is no plain name: it holds a path separator
    """
    check_name(f"{place}: run_id", run.run_id, LogError)
    check_name(f"{place}: robot", run.robot, LogError)
    if run.session:
        check_name(f"{place}: session", run.session, LogError)
    if run.filter:
        check_name(f"{place}: filter", run.filter, LogError)
    for terrain in run.terrains:
        check_name(f"{place}: terrain", terrain, LogError)
    for name, stream in run.streams.items():
        check_name(f"{place}: stream", name, LogError)
        for channel in stream.channels:
            check_name(f"{place}: channel", channel, LogError)
    for kind in run.dropped:
        if has_control_characters(kind):
            raise LogError(f"{place}: key {shown(kind)} of 'dropped' holds a control character")
    return run
