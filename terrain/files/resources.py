"""Where the packaged YAML lies: ``data/`` in a checkout, ``terrain/_data`` in a wheel."""

from __future__ import annotations

from pathlib import Path


def data_folder(kind: str) -> Path:
    """Return the folder of packaged YAML of one kind: ``robots``, ``target_slip``.

    Examples
    --------
    >>> (data_folder("robots") / "husky.yaml").is_file()
    True
    """
    package = Path(__file__).parents[1]
    installed = package / "_data" / kind
    return installed if installed.is_dir() else package.parent / "data" / kind
