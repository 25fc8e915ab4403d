"""Who may speak to the service, and how much: tokens, origins, rates."""

from __future__ import annotations

import hmac
import ipaddress
from collections.abc import Mapping
from urllib.parse import urlsplit

from terrain.errors import ConfigError

SHORTEST_TOKEN = 16
"""Characters; a shorter one can be tried out."""

LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")


def is_loopback(host: str) -> bool:
    """Say whether a host to listen on is reached from this machine only.

    Examples
    --------
    >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("0.0.0.0"), is_loopback("robot.local")
    (True, True, False, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check_token(host: str, token: str) -> None:
    """Refuse to listen to other machines without a token, or with one that is too short.

    Raises
    ------
    ConfigError
        where it is.
    """
    if token and len(token) < SHORTEST_TOKEN:
        raise ConfigError(
            f"the token has {len(token)} characters, at least {SHORTEST_TOKEN} are required "
            "(python -c 'import secrets; print(secrets.token_urlsafe())' makes one)"
        )
    if not token and not is_loopback(host):
        raise ConfigError(f"--host {host} is reached from other machines: a token is required (--token-file)")


def token_fits(required: str, given: str) -> bool:
    """Say whether a token is the required one, in a time that does not tell how much of it is right."""
    return not required or hmac.compare_digest(required.encode(), given.encode("utf-8", "replace"))


def bearer(headers: Mapping[str, str]) -> str:
    """Return the token of an ``Authorization: Bearer`` header; empty without one."""
    kind, _, token = headers.get("authorization", "").partition(" ")
    return token.strip() if kind.lower() == "bearer" else ""


def foreign(headers: Mapping[str, str], *, loopback: bool) -> str:
    """Return why a request must come from another site's page; empty where it need not.

    A browser lets any page reach this machine.  It tells the page's origin, which has to be the host that
    was asked; and where only this machine is listened to, that host has to be this machine by its own name.

    Examples
    --------
    >>> foreign({"host": "127.0.0.1:8765", "origin": "http://127.0.0.1:8765"}, loopback=True)
    ''
    >>> foreign({"host": "127.0.0.1:8765", "origin": "http://evil.example"}, loopback=True)
    "the request is of a page of 'evil.example'"
    """
    host = headers.get("host", "")
    origin = headers.get("origin")
    name = _name(f"//{host}")
    if loopback and host and name not in LOCAL_NAMES:
        return f"the host {name!r} is not this machine"
    if origin is not None and urlsplit(origin).netloc != host:
        return f"the request is of a page of {_name(origin)!r}"
    return ""


def _name(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


class Bucket:
    """A rate limit: so many a second, and a second's worth at once.

    Examples
    --------
    >>> bucket = Bucket(10.0)
    >>> bucket.take(10, 0.0), bucket.take(1, 0.0), bucket.take(1, 0.5)
    (True, False, True)
    """

    def __init__(self, per_s: float) -> None:
        self._per_s = self._left = per_s
        self._now_s: float | None = None

    def take(self, n: float, now_s: float) -> bool:
        """Say whether n more are within the rate; if so they are taken."""
        if self._now_s is not None:
            self._left = min(self._left + (now_s - self._now_s) * self._per_s, self._per_s)
        self._now_s = now_s
        if n > self._left:
            return False
        self._left -= n
        return True
