"""Words of robots on tracks, in sentences and pages that are written for wheels."""

from __future__ import annotations

import re

from terrain.effects import TRACKED

_WHEELS = re.compile(r'"data:[^"]*"|\bwheel radius\b|\b[Ww]heels?\b')
"""Words of robots on wheels, and pictures, which have none."""

_OF_TRACKS = {"wheel radius": "sprocket radius", "wheel": "track", "wheels": "tracks"}


def in_words_of(drive: str, text: str) -> str:
    """Return sentences, or a page, in the words of robots of a drive.

    Examples
    --------
    >>> in_words_of("tracked", "The simulation lacks wheel radius (2 %); its wheels turn it at 0.3 rad/s.")
    'The simulation lacks sprocket radius (2 %); its tracks turn it at 0.3 rad/s.'
    """
    if drive != TRACKED:
        return text

    def of_tracks(found: re.Match[str]) -> str:
        word = _OF_TRACKS.get(found[0].lower(), found[0])
        return word.capitalize() if found[0][0] == "W" else word

    return _WHEELS.sub(of_tracks, text)
