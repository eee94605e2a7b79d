"""Header of a report: content of the table `[report]` of `setup.toml`."""

from __future__ import annotations

from ltsim.recordings.keys import Date, SingleLine, TomlSection


class ReportHeader(TomlSection):
    """Header of a report (table `[report]`); no result depends on it."""

    instrument: SingleLine | None = None
    """Manufacturer, model and serial number, such as "Leica AT960, 751234"; by default taken from the tables of the
    instruments."""
    date: Date | None = None
    """Day of the measurement in ISO format (2026-05-31)."""
    operator: SingleLine | None = None
    """Name of the operator."""
    customer: SingleLine | None = None
    """Name of the customer."""
