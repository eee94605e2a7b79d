"""Times of the pointings of a table: search for the column of times, and its conversion to seconds."""

from dataclasses import replace

import numpy as np

from ltsim.core.units import SI_PER_UNIT
from ltsim.recordings.files import safe_excerpt
from ltsim.recordings.hints import Hints
from ltsim.recordings.spreadsheets import cells
from ltsim.recordings.tables.pointing_table import PointingTable


def with_time_column(table: PointingTable) -> PointingTable:
    """Table in which the column of times is determined; the table is changed in place.

    If no title denotes times, the first additional column with times of day is used. A column of rounds in which each
    round has one pointing becomes an additional column, because a round is a set of directions to several targets.
    """
    rounds = table.column_with_role(("round",))
    if rounds is not None and table.pointings.every_round_has_single_pointing:
        table.columns = [replace(c, role="") if c is rounds else c for c in table.columns]
        table.notes.append(
            f"'{safe_excerpt(rounds.title)}' differs in each pointing and is not interpreted as the round; if it is "
            f'the time, give --columns "time={safe_excerpt(rounds.title)}[s]"'
        )
    if table.column_with_role(("time",)) is not None:
        return table
    pointings = table.pointings
    for column in table.columns:
        texts = pointings.additional_cells.get(column.title, [])
        filled = [text for text in texts if text]
        if not column.is_additional or column.role or not filled or not all(map(cells.has_time_of_day, filled)):
            continue
        title = column.title
        pointings.date_and_time = [
            " ".join(filter(None, both)) for both in zip(pointings.date_and_time, texts, strict=True)
        ]
        pointings.additional_cells = {
            name: cells_of for name, cells_of in pointings.additional_cells.items() if name != title
        }
        table.columns = [replace(c, role="time", unit="") if c is column else c for c in table.columns]
        table.notes.append(
            f"'{safe_excerpt(title)}' is interpreted as the time of each pointing, because its cells are times of day"
        )
        break
    return table


def pointing_times(table: PointingTable, hints: Hints) -> tuple[list[float], str, list[str]]:
    """Time [s] of each pointing since time 0 (NaN if unreadable), time 0 in ISO format or '', and notes."""
    column = table.column_with_role(("time",)) or table.column_with_role(("date",))
    texts = table.pointings.date_and_time
    missing = [float("nan")] * len(texts)
    if column is None or not any(texts):
        return missing, "", []
    consequence = "the order of the rows replaces the time"
    if not all(texts):
        return missing, "", [f"column '{safe_excerpt(column.title)}' is empty in some rows: {consequence}"]
    plain_times = cells.plain_numbers(texts)
    if plain_times is not None and column.role == "date":
        return (
            missing,
            "",
            [f"column '{safe_excerpt(column.title)}' contains numbers of days without a time: {consequence}"],
        )
    if plain_times is not None:
        return (plain_times * SI_PER_UNIT[column.unit or "s"]).tolist(), "", []
    times = [cells.parse_number(text) for text in texts]
    if all(number is not None for number in times):
        factor = SI_PER_UNIT[column.unit or "s"]
        return [float(number) * factor for number in times if number is not None], "", []
    seconds, start = cells.parse_times(texts, hints.date)
    if seconds is None and start:
        question = f"the date '{safe_excerpt(texts[0])}' may begin with the day or with the month"
        message = f"{question}; give --hint date=dmy or --hint date=mdy"
        raise table.pointings.source_location(0).error(message, safe_excerpt(column.title))
    if seconds is None:
        reason = f"column '{safe_excerpt(column.title)}' contains no readable time ('{safe_excerpt(texts[0])}')"
        return missing, "", [f"{reason}: {consequence}"]
    if not any(map(cells.has_time_of_day, texts)):
        return missing, "", [f"column '{safe_excerpt(column.title)}' contains dates without a time: {consequence}"]
    earliest = texts[int(np.argmin(seconds))]
    if hints.date is None and len({cells.parse_times([earliest], order)[1] for order in ("dmy", "mdy")} - {""}) > 1:
        day_order, other = (
            ("day and month", "mdy") if cells.parse_times([earliest], "dmy")[1] == start else ("month and day", "dmy")
        )
        note = (
            f"the date in '{safe_excerpt(earliest)}' is interpreted as {day_order} (otherwise give --hint date={other})"
        )
        return seconds, start, [note]
    return seconds, start, []
