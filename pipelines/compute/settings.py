"""Where a command computes."""

from __future__ import annotations

import re
from typing import Self

from pydantic import model_validator

from pipelines.report.settings import Settings, setting
from terrain.errors import ConfigError

LOCAL = "local"
_ADDRESS = re.compile(
    r"dask:(?:(?P<scheme>tcp|tls)://)?(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:]+\]):(?P<port>\d{1,5})"
)
MAX_PORT = 65535


def scheduler_address(compute: str) -> str | None:
    """Return the address of the scheduler that ``compute`` names; None for this machine's cores.

    Parameters
    ----------
    compute : ``local``, or ``dask:HOST:PORT`` with or without ``tcp://`` or ``tls://`` before the host

    Raises
    ------
    ConfigError
        if it is none of these.

    Examples
    --------
    >>> scheduler_address("dask:127.0.0.1:8786"), scheduler_address("local")
    ('tcp://127.0.0.1:8786', None)
    """
    if compute == LOCAL:
        return None
    found = _ADDRESS.fullmatch(compute)
    if found is None or not 0 < int(found["port"]) <= MAX_PORT:
        raise ConfigError(
            f"--compute is {compute!r}: 'local' or the address of a Dask scheduler is accepted, "
            "as dask:tcp://127.0.0.1:8786"
        )
    return f"{found['scheme'] or 'tcp'}://{found['host']}:{found['port']}"


class ComputeSettings(Settings):
    """Where a command computes what can be computed side by side."""

    compute: str = setting(LOCAL, "local, or dask:HOST:PORT: the workers of a Dask scheduler.")

    @model_validator(mode="after")
    def _check_address(self) -> Self:
        scheduler_address(self.compute)
        return self
