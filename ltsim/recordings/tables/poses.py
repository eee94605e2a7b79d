"""Tables without point names, or with one for all rows: positions of a target that moves (a robot, a T-MAC)."""

from itertools import product
from operator import add, sub

import numpy as np

from ltsim.core.arrays import Ints
from ltsim.core.errors import RecordError
from ltsim.recordings.files import shown
from ltsim.recordings.tables.header import HORIZONTAL, PLACE, VERTICAL
from ltsim.recordings.tables.printed import PointingTable, as_floats

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
    names, stations = {*table.pointings.target}, {*table.pointings.station}
    if len(names) > 1 or (names != {""} and len(table.pointings) < LEAST_ROWS):
        return table
    places = _places(table)
    count = int(places.max()) + 1
    if names != {""} and (count < LEAST_ROWS or len(stations) > 1):
        return table
    if len(stations) > 1:
        message = "names no points, and nothing tells which targets of its set-ups are the same; add a column target"
        raise RecordError(message, file=file)
    table.pointings.target = [f"pose-{place + 1}" for place in places.tolist()]
    called = "names no points" if names == {""} else f"has one name ('{shown(names.pop())}') for all of its rows"
    table.notes.append(
        f"the table {called}: its {len(places)} rows are {count} positions of a target that moves (a robot, a T-MAC), "
        "each a target named pose-1, pose-2, ...; one set-up alone says nothing of the tracker"
    )
    return table


def _places(table: PointingTable) -> Ints:
    """Number of the place (n,) of each row, in the order of their first rows."""
    numbers = table.pointings.numbers
    printed = np.stack([as_floats(digits) for digits in numbers.values()], axis=1)
    largest = np.nanmax(np.abs(printed), axis=0).tolist()
    lengths = max((size for role, size in zip(numbers, largest, strict=True) if role in PLACE), default=0.0)
    tolerance = np.array([_tolerance(role, size, lengths) for role, size in zip(numbers, largest, strict=True)])
    scaled = np.nan_to_num(printed / tolerance)
    steps = list(product((0, -1, 1), repeat=scaled.shape[1]))
    first: list[tuple[float, ...]] = []
    of_box: dict[tuple[int, ...], int] = {}  # no two places lie in one box of unit size
    found = []
    for row, box in zip(scaled.tolist(), np.floor(scaled).astype(np.int64).tolist(), strict=True):
        around = [of_box[other] for step in steps if (other := tuple(map(add, box, step))) in of_box]
        near = [i for i in around if max(map(abs, map(sub, row, first[i]))) < 1.0]
        if not near:
            of_box[tuple(box)] = len(first)
            first.append(tuple(row))
        found.append(min(near, default=len(first) - 1))
    return np.array(found)


def _tolerance(role: str, largest: float, lengths: float) -> float:
    if role in (*HORIZONTAL, *VERTICAL):
        return SAME_ANGLE if largest > RADIANS else SAME_RADIAN
    return SAME_SHARE * max(lengths, largest, 1e-9)
