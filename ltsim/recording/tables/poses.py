"""Tables without point names, or with one for all rows: positions of a target that moves (a robot, a T-MAC)."""

from dataclasses import replace

import numpy as np

from ltsim.arrays import Floats, Ints
from ltsim.errors import RecordError
from ltsim.recording.files import shown
from ltsim.recording.tables.header import HORIZONTAL, PLACE, VERTICAL
from ltsim.recording.tables.rows import PointingTable

SAME_SHARE = 3e-4
"""Share of the largest length by which rows at one place differ: 1 mm at 3 m, more than a robot repeats."""
SAME_ANGLE, SAME_RADIAN = 0.02, SAME_SHARE
"""[deg or gon, rad] By which directions to one place differ."""
RADIANS = 7.0
LEAST_ROWS = 3


def named_by_place(table: PointingTable, file: object) -> PointingTable:
    """The table; where its rows have no names, or one name at several places, every place is a target of its own.

    Raises RecordError where several set-ups have no names: nothing then tells which of their targets are the same.
    """
    names = {p.target for p in table.pointings}
    if len(names) > 1 or (names != {""} and len(table.pointings) < LEAST_ROWS):
        return table
    places = _places(table)
    count = int(places.max()) + 1
    if names != {""} and (count < LEAST_ROWS or len({p.station for p in table.pointings}) > 1):
        return table
    if len({p.station for p in table.pointings}) > 1:
        message = "names no points, and nothing tells which targets of its set-ups are the same; add a column target"
        raise RecordError(message, file=file)
    table.pointings = [
        replace(p, target=f"pose-{place + 1}") for p, place in zip(table.pointings, places.tolist(), strict=True)
    ]
    called = "names no points" if names == {""} else f"has one name ('{shown(names.pop())}') for all of its rows"
    table.notes.append(
        f"the table {called}: its {len(places)} rows are {count} positions of a target that moves (a robot, a T-MAC), "
        "each a target named pose-1, pose-2, ...; one set-up alone says nothing of the tracker"
    )
    return table


def _places(table: PointingTable) -> Ints:
    """Number of the place (n,) of each row, in the order of their first rows."""
    roles = list(dict.fromkeys(role for p in table.pointings for role in p.values))
    printed = np.array([[float(p.values.get(role, "nan")) for role in roles] for p in table.pointings])
    largest = np.nanmax(np.abs(printed), axis=0)
    lengths = max((largest[i] for i, role in enumerate(roles) if role in PLACE), default=0.0)
    tolerance = np.array([_tolerance(role, size, lengths) for role, size in zip(roles, largest.tolist(), strict=True)])
    first: list[Floats] = []
    found = []
    for row in np.nan_to_num(printed / tolerance):
        near = [i for i, other in enumerate(first) if np.abs(row - other).max() < 1.0]
        if not near:
            first.append(row)
        found.append(near[0] if near else len(first) - 1)
    return np.array(found)


def _tolerance(role: str, largest: float, lengths: float) -> float:
    if role in (*HORIZONTAL, *VERTICAL):
        return SAME_ANGLE if largest > RADIANS else SAME_RADIAN
    return SAME_SHARE * max(lengths, largest, 1e-9)
