"""What a table of target slips aims for on each terrain, ready for the control loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from terrain.control.slick import Braking, braking_by_slip
from terrain.control.slip_table import SlipTable
from terrain.records import SlipTarget

MARGIN_MAX_RATIO = 0.06
"""The difference of a table's targets in traction and in steady motion is the slip above the balance that
gives the working pull; up to this much is added to the measured balance.  A larger difference is that of a
table that aims for a peak."""


class Aim(NamedTuple):
    """What a table aims for on a terrain.

    Parameters
    ----------
    entry : of the table, by drive state
    slip_ratio, margin_ratio : target in traction, and by how much it is above that of steady motion
    braking : by controlled slip; None where locked wheels stop as soon or no curve was learned
    """

    entry: Mapping[str, SlipTarget]
    slip_ratio: float
    margin_ratio: float
    braking: Braking | None


class Aims(dict[str, Aim]):
    """The aims of a table by terrain; that of its fallback for any other.

    Examples
    --------
    >>> from terrain.control.slip_table import load_slip_table
    >>> aims = Aims(load_slip_table())
    >>> aims["mud"] == aims[""]
    True
    """

    def __init__(self, table: SlipTable) -> None:
        super().__init__({terrain: _aim(table, terrain) for terrain in table.targets})
        self._fallback = self[table.fallback]

    def __missing__(self, terrain: str) -> Aim:
        return self._fallback


def _aim(table: SlipTable, terrain: str) -> Aim:
    entry = table.lookup(terrain)
    traction = entry["traction"]
    margin = min(traction.slip_ratio - entry["steady"].slip_ratio, MARGIN_MAX_RATIO)
    return Aim(entry, traction.slip_ratio, margin, braking_by_slip(table.curves.get(traction.terrain)))
