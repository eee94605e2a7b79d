"""Header of a report, as a table of `setup.toml`."""

from __future__ import annotations

from ltsim.recordings.keys import Date, SingleLine, TomlSection


class ReportHeader(TomlSection):
    """Header of a report, table `[report]`; it has no influence on results."""

    instrument: SingleLine | None = None
    """Manufacturer, model and serial number, such as "Leica AT960, 751234"; by default those that the tables of the
    instruments declare.
    """
    date: Date | None = None
    """Day of the measurement, year-month-day."""
    operator: SingleLine | None = None
    """Name of the operator."""
    customer: SingleLine | None = None
    """Name of the customer."""
