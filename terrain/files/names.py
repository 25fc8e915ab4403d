"""Names that can be those of folders and files."""

from __future__ import annotations

import re

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._+-]*")


def plain_name(name: str) -> bool:
    """Say whether a name can be that of a folder or a file, and is no path.

    Examples
    --------
    >>> plain_name("SANDY_LOAM"), plain_name("../SNOW"), plain_name("")
    (True, False, False)
    """
    return _PLAIN_NAME.fullmatch(name) is not None
