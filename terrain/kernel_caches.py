"""Compiled kernels that are older than what they call are removed when the package is imported.

numba compares a cached kernel with its own file only: a function, a constant or a place of a parameter that a
kernel takes from another file is compiled into it, and stays what it was when that file changes, after an
update of the package, too.  Beside the caches therefore lies a digest of all files that each kernel's file
imports, directly or not.  Where a digest differs, that file's kernels are removed, and compiled anew when
they are called.

Sizes and times of all files are compared first, in about 2 ms; the digests are made only where those differ.
Where nothing can be written, as in an installation without a cache of its own, nothing is done.
"""

from __future__ import annotations

import os
import zlib
from pathlib import Path

STAMP_FILE = "kernels.txt"
"""First a stamp of sizes and times, then a line for each file with kernels: its digest and its name."""


def discard_stale(package: Path, *imported: Path) -> list[Path]:
    """Remove the compiled kernels of a package whose sources, or what these import, have changed.

    Parameters
    ----------
    package : folder of the package
    imported : folders of other packages that its kernels import

    Returns
    -------
    Files with kernels whose caches are no longer used; empty where nothing changed or nothing can be written
    """
    home = _home(package)
    if home is None:
        return []
    stamp = _stamp((package, *imported))
    file = home / STAMP_FILE
    try:
        before = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        before = []
    if before[:1] == [stamp]:
        return []
    known = {name: digest for digest, _, name in (line.partition(" ") for line in before[1:])}
    digests = _digests(package, imported)
    names = {path: path.relative_to(package).as_posix() for path in digests}
    stale = [path for path, digest in digests.items() if known.get(names[path]) != digest]
    try:
        for path in stale:
            for folder in _cache_folders(path):
                for cached in folder.glob(f"{path.stem}.*.nb[ic]"):
                    cached.unlink(missing_ok=True)
        text = "\n".join([stamp, *(f"{digest} {names[path]}" for path, digest in digests.items())]) + "\n"
        temporary = file.with_name(f".{STAMP_FILE}.{os.getpid()}")
        temporary.write_text(text, encoding="utf-8")
        temporary.replace(file)
    except OSError:
        return []
    return stale


def _home(package: Path) -> Path | None:
    """Return the folder of the stamp: the package's own, else one where numba caches, if there is any."""
    for folder in _cache_folders(package / "__init__.py"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return None


def _cache_folders(source: Path) -> list[Path]:
    """Return where numba may cache the kernels of a file (numba.core.caching)."""
    folder = source.absolute().parent
    places = [folder / "__pycache__"]
    user = os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()
    for root in (os.environ.get("NUMBA_CACHE_DIR"), Path(user) / "numba"):
        if root and Path(root).is_dir():
            from hashlib import sha1

            named = f"{folder.name}_{sha1(str(folder).encode(), usedforsecurity=False).hexdigest()}"
            places.append(Path(root) / named)
    return places


def _stamp(packages: tuple[Path, ...]) -> str:
    """Return a checksum of the sizes and times of all sources."""
    entries: list[str] = []
    for package in packages:
        folders = [str(package)]
        while folders:
            with os.scandir(folders.pop()) as found:
                for entry in found:
                    if entry.name.endswith(".py"):
                        status = entry.stat()
                        name = entry.path.removeprefix(str(package))
                        entries.append(f"{name} {status.st_size} {status.st_mtime_ns}")
                    elif "." not in entry.name and entry.name != "__pycache__" and entry.is_dir():
                        folders.append(entry.path)
    return f"{zlib.crc32(' '.join(sorted(entries)).encode()):08x}"


def _digests(package: Path, imported: tuple[Path, ...]) -> dict[Path, str]:
    """Return a digest of each file with kernels and of all that it imports of the packages."""
    from hashlib import sha256

    modules = {}
    for root in (package, *imported):
        for path in sorted(root.rglob("*.py")):
            parts = path.relative_to(root.parent).with_suffix("").parts
            modules[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    contents = {name: path.read_bytes() for name, path in modules.items()}
    imports: dict[str, set[str]] = {}
    digests = {}
    for name, path in modules.items():
        if b"njit" not in contents[name] or not path.is_relative_to(package) or name == __name__:
            continue
        reached, waiting = {name}, [name]
        while waiting:
            module = waiting.pop()
            if module not in imports:
                imports[module] = _imports(contents[module], modules)
            waiting += imports[module] - reached
            reached |= imports[module]
        digest = sha256()
        for module in sorted(reached):
            digest.update(module.encode() + contents[module])
        digests[path] = digest.hexdigest()
    return digests


def _imports(source: bytes, modules: dict[str, Path]) -> set[str]:
    """Return those of the modules that a source imports by their full names."""
    import ast

    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found & modules.keys()
