"""Times of a table's pointings: which column holds them, and what its texts mean."""

from dataclasses import replace

from ltsim.core.units import FACTOR
from ltsim.recordings.conventions import Hints
from ltsim.recordings.files import shown
from ltsim.recordings.tables import cells
from ltsim.recordings.tables.printed import PointingTable, as_digits, as_floats


def with_clock(table: PointingTable) -> PointingTable:
    """The table; where no header names a time, the first further column of clocks is its time."""
    if table.column(("time",)) is not None:
        return table
    printed = table.pointings
    for column in table.columns:
        texts = printed.further.get(column.title, [])
        filled = [text for text in texts if text]
        if not column.is_further or column.role or not filled or not all(map(cells.has_clock, filled)):
            continue
        title = column.title
        printed.moment = [" ".join(filter(None, both)) for both in zip(printed.moment, texts, strict=True)]
        printed.further = {name: one for name, one in printed.further.items() if name != title}
        table.columns = [replace(c, role="time", unit="") if c is column else c for c in table.columns]
        table.notes.append(f"'{shown(title)}' taken as the time of each pointing: its cells are clocks")
        break
    return table


def times_of(table: PointingTable, hints: Hints) -> tuple[list[float], str, list[str]]:
    """Time [s] of each pointing, the moment of 0 where it is known, and notes; NaN where times cannot be read."""
    column = table.column(("time",)) or table.column(("date",))
    texts = table.pointings.moment
    nothing = [float("nan")] * len(texts)
    if column is None or not any(texts):
        return nothing, "", []
    by_rows = "the order of the rows is taken as time"
    if not all(texts):
        return nothing, "", [f"column '{shown(column.title)}' is empty in places: {by_rows}"]
    if cells.are_numbers(texts):
        return (as_floats(as_digits(texts)) * FACTOR[column.unit or "s"]).tolist(), "", []
    numbers = [cells.number(text) for text in texts]
    if all(number is not None for number in numbers):
        factor = FACTOR[column.unit or "s"]
        return [float(number) * factor for number in numbers if number is not None], "", []
    found, start = cells.moments(texts, hints.date)
    if found is None and start:
        message = f"'{shown(texts[0])}' may be day and month or month and day; say which: --hint date=dmy or date=mdy"
        raise table.pointings.place(0).wrong(message, shown(column.title))
    if found is None:
        unknown = f"column '{shown(column.title)}' holds no time that is known here ('{shown(texts[0])}')"
        return nothing, "", [f"{unknown}: {by_rows}"]
    if not any(":" in text for text in texts):
        return nothing, "", [f"column '{shown(column.title)}' holds days without a clock: {by_rows}"]
    return found, start, []
