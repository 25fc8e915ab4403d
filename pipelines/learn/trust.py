"""Which modules of one's own a model may run: those that were trusted by name.

A model with own code keeps the names of what it needs, ``MODULE.NAME``; the code itself stays where it is.  Nothing of
a module is imported before a user has trusted it: by ``--trust MODULE``, which is remembered in
``terrain/trusted_modules.json`` of the user's configuration folder with the file that the module is, so that another
file of that name is not taken for it.  Who trains a model trusts what it is trained with.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from terrain.errors import ConfigError, ModelError
from terrain.files.atomic import atomic_write, ensure_writable
from terrain.files.documents import read_json
from terrain.files.names import MAX_NAME, printable

#: Modules that are never run by their names in a model: what they hold is on the list of types, or is none of a model.
NEVER = sys.stdlib_module_names | {
    "__main__",
    "terrain",
    "features",
    "pipelines",
    "numpy",
    "scipy",
    "sklearn",
    "skops",
}


def trust_file() -> Path:
    """Return the file of the trusted modules: below XDG_CONFIG_HOME, or ``~/.config``."""
    folder = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(folder).expanduser() / "terrain" / "trusted_modules.json"


def remember(names: Iterable[str]) -> None:
    """Trust modules from now on, given by their names or by names of what they hold.

    Raises
    ------
    TerrainError
        if there is no such module, it is never trusted, or the folder cannot be written.
    """
    found = {}
    for module in sorted({name.partition(".")[0] for name in names}):
        if module in NEVER or not module.isidentifier():
            raise ConfigError(f"module {module!r} is not trusted: it is none of your own")
        if not (place := place_of(module)):
            raise ConfigError(f"there is no module {module!r} to trust, in the current folder or installed")
        found[module] = place
    known = _remembered()
    if found.items() - known.items():
        ensure_writable(trust_file().parent)
        trust_file().parent.mkdir(parents=True, exist_ok=True)
        atomic_write(trust_file(), json.dumps(known | found, indent=1) + "\n")


def check_trusted(names: Iterable[str], trusted: Iterable[str] = ()) -> None:
    """Refuse by ``ModelError`` names in a model of modules that are not trusted here, nor were before."""
    allowed, known = {each.partition(".")[0] for each in trusted}, _remembered()
    for name in names:
        module = name.partition(".")[0]
        there = module in known and known[module] == place_of(
            module
        )  # of others the current folder is not searched
        if module in NEVER or not (module in allowed or there):
            module, name = printable(module[:MAX_NAME]), printable(name[:MAX_NAME])
            raise ModelError(
                f"it needs code of its own, {name}, which is run only where you trust it: --trust {module}, once, or "
                f"trust=({module!r},) in Python"
            )


def import_own(names: Iterable[str]) -> None:
    """Import what names mean; ``ModelError`` where one is of another module than it says, or of none of a user's."""
    for name in names:
        module, _, attribute = name.rpartition(".")
        top = module.partition(".")[0]
        if top in NEVER:
            raise ModelError(f"{name} is in no module of yours")
        try:
            place_of(top)
            found = getattr(import_module(module), attribute)
        except (Exception, SystemExit) as error:  # a script ends itself
            raise ModelError(f"{name} cannot be imported: {error}") from error
        if str(getattr(found, "__module__", "")).partition(".")[0] != top:
            raise ModelError(f"{name} is none of module {top}")


def place_of(module: str) -> str:
    """Return the file or folders that a module would be imported from, which is not done; empty without one.

    The current folder is searched from then on only where the module is nowhere else: what an installed module imports
    where it is there, as many do, is not to be found in a folder that somebody else has filled.
    """
    try:
        spec = find_spec(module)
        if spec is None and (folder := str(Path.cwd())) not in sys.path:
            sys.path.append(folder)  # last, so that none hides a library
            spec = find_spec(module)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    places = [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())
    return os.pathsep.join(str(Path(place).resolve()) for place in places)


def _remembered() -> dict[str, str]:
    file = trust_file()
    if not file.is_file():
        return {}
    known = read_json(file, str(file), ConfigError)
    if not isinstance(known, dict) or not all(isinstance(place, str) for place in known.values()):
        raise ConfigError(f"{file}: is no table of modules and their files")
    return known
