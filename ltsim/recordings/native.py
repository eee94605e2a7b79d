"""Native format of recordings (ltsim-recording/1): a folder with `observations.csv` and `setup.toml`."""

import csv
import difflib
import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError, require_columns
from ltsim.core.limits import MAX_TABLE_COLUMNS
from ltsim.core.notation import escape_cell_text, unescape_cell_text
from ltsim.core.units import DEGREE, MILLIMETRE, SI_PER_UNIT, UNIT_BY_SPELLING
from ltsim.recordings.files import (
    SourceLocation,
    is_not_finite,
    is_number,
    read_lines,
    safe_excerpt,
    write_texts,
)
from ltsim.recordings.hints import NO_HINTS, Hints
from ltsim.recordings.occupations import check_centring_tables
from ltsim.recordings.pointings import index_names
from ltsim.recordings.recording import (
    DISTANCE_KIND_COLUMN,
    DISTANCE_METER_COLUMN,
    OCCUPATION_COLUMNS,
    REFLECTOR_COLUMN,
    SIGMA_COLUMNS,
    Recording,
)
from ltsim.recordings.references import ReferenceLengths, check_reference_difference_ends
from ltsim.recordings.reflectors import excess_radii, smr_names
from ltsim.recordings.settings import read_setup, setup_to_toml, validate_setup
from ltsim.recordings.setup import Setup
from ltsim.recordings.specification import keys_deviating_from_data_sheet
from ltsim.recordings.spreadsheets.cells import plain_numbers
from ltsim.recordings.spreadsheets.sheets import SheetRow, is_table_folder
from ltsim.recordings.transcription_errors import require_degrees_and_millimetres

OBSERVATIONS_FILE = "observations.csv"
SETUP_FILE = "setup.toml"
REQUIRED_COLUMNS = ("station", "target", "face", "azimuth_deg", "elevation_deg", "distance_mm")
READING_COLUMNS = ("distance_mm", "azimuth_deg", "elevation_deg")
STANDARD_COLUMNS = (*REQUIRED_COLUMNS, "repeat", "time_s")
ENUMERATED_COLUMNS = {DISTANCE_METER_COLUMN: ("adm", "ifm", ""), DISTANCE_KIND_COLUMN: ("slope", "horizontal", "")}
TEXT_COLUMNS = (*ENUMERATED_COLUMNS, REFLECTOR_COLUMN, *OCCUPATION_COLUMNS)
COLUMN_VALUE_BOUNDS = {
    "distance_mm": (0.001, 1e9),
    "azimuth_deg": (-720.0, 720.0),
    "elevation_deg": (-90.0, 270.0),
    "time_s": (-1e10, 1e10),
    "air_temperature_c": (-60.0, 80.0),
    "air_pressure_hpa": (300.0, 1200.0),
    "relative_humidity_pct": (0.0, 100.0),
    **dict.fromkeys(SIGMA_COLUMNS, (1e-9, 1e9)),
}
"""Smallest and largest permitted number in each column of numbers, in the unit in the column's name."""
WRONG_UNIT_SUFFIXES = ("k", "f", "pa", "bar", "inch")
"""Endings of column names that show a wrong unit, in addition to the units that ltsim knows."""
TextTable = tuple[list[str], list[Sequence[str]]]
"""Column names and column texts of a table such as `observations.csv`; as rows they would take twice the memory."""
MAX_NAME_COMPARISONS = 100_000
"""Largest number of pairs of names, in all notes on a recording, that are compared to propose similar names; a
comparison takes 5 us."""
MAX_INTERNED_TEXTS = 10_000
"""Largest number of different cell texts of a file for which equal cells share one string, to save memory."""


def recognises(path: Path, file_beginning: str) -> bool:
    """True if `path` is a recording folder or its `observations.csv`."""
    return (path.is_dir() and not is_table_folder(path)) or path.name == OBSERVATIONS_FILE


def read_recording(path: Path, hints: Hints = NO_HINTS) -> Recording:
    """Recording from its folder, or from the path of its `observations.csv`; raises RecordError.

    With `hints.is_growing` the file may still grow: an incomplete last row is ignored, and targets of reference
    lengths may be missing. If `hints` declares clockwise azimuths, their sign is changed.
    """
    folder = path.parent if path.name == OBSERVATIONS_FILE else path
    if not folder.is_dir():
        message = f"there is no such folder; a recording is a folder with {OBSERVATIONS_FILE} and {SETUP_FILE}"
        raise RecordError(message, file=path)
    table = _read_table(folder / OBSERVATIONS_FILE, is_growing=hints.is_growing)
    recording = parse_observations(table, read_setup(folder / SETUP_FILE), folder, is_growing=hints.is_growing)
    sense = [1.0, -1.0 if hints.azimuth == "clockwise" else 1.0, 1.0]
    return recording.with_readings(recording.readings * sense)


def _read_table(path: Path, *, is_growing: bool) -> TextTable:
    """Column names and columns of a CSV file, without an incomplete last row if `is_growing`; or RecordError."""
    lines = read_lines(path)
    if lines[-1] and is_growing:
        lines = lines[:-1]
    elif lines[-1]:
        raise SourceLocation(path, len(lines) - 1).error(
            "the file ends inside this row, without a line break, and is incomplete"
        )
    rows, texts = list[list[str]](), dict[str, str]()
    try:
        for fields in csv.reader(_yield_and_free_lines(lines), strict=True):
            cells = [texts.get(cell, cell) for cell in map(str.strip, fields)]
            if len(texts) < MAX_INTERNED_TEXTS:
                texts.update(zip(cells, cells, strict=True))
            if any(cells):
                if len(cells) > MAX_TABLE_COLUMNS:
                    raise SourceLocation(path, len(rows)).error(
                        f"{len(cells)} columns, expected at most {MAX_TABLE_COLUMNS}"
                    )
                rows.append(cells)
                if len(cells) != len(rows[0]):
                    SheetRow(len(rows) - 1, tuple(cells)).check_width(len(rows[0]), path)
    except csv.Error as problem:
        raise SourceLocation(path, len(rows)).error(f"is not CSV here ({problem})") from None
    if len(rows) < 2:
        raise RecordError("the file contains only a header, expected one row per pointing", file=path)
    return rows[0], list(zip(*rows[1:], strict=True))


def _yield_and_free_lines(lines: list[str]) -> Iterator[str]:
    """Lines in order; each line is removed from the list before it is yielded, which frees its memory."""
    lines.reverse()
    while lines:
        yield lines.pop()


def parse_observations(table: TextTable, setup: Setup, folder: Path, *, is_growing: bool = False) -> Recording:
    """Recording from the texts of `observations.csv` and its set-up; `folder` is named in errors.

    With `is_growing`, for an unfinished file, reference values and centring errors are not checked.
    """
    file = folder / OBSERVATIONS_FILE
    header = list(map(unescape_cell_text, table[0]))
    _check_header(header, file)
    columns = {name: list(map(unescape_cell_text, column)) for name, column in zip(header, table[1], strict=True)}
    stations, station = index_names(columns["station"], "station", file)
    targets, target = index_names(columns["target"], "target", file)
    n_rows = len(station)
    face = _integer_column(columns["face"], SourceLocation(file, column="face"), (1, 2))
    repeat, time = np.ones(n_rows, dtype=np.int64), np.arange(n_rows, dtype=np.float64)
    if "repeat" in columns:
        repeat = _integer_column(columns["repeat"], SourceLocation(file, column="repeat"), (1, 1_000_000))
    if "time_s" in columns:
        time = _float_column(columns["time_s"], SourceLocation(file, column="time_s"), is_optional=False)
    measured = np.stack(
        [_float_column(columns[name], SourceLocation(file, column=name)) for name in READING_COLUMNS], axis=1
    )
    empty_rows = np.flatnonzero(np.all(np.isnan(measured), axis=1))
    if len(empty_rows):
        message = "the row has no reading; expected an azimuth, an elevation or a distance"
        raise SourceLocation(file, int(empty_rows[0]) + 1).error(message)
    require_degrees_and_millimetres(measured, station, target, face, file)
    covariates, labels = _additional_columns(columns, file)
    recording = Recording(
        setup=setup,
        stations=stations,
        targets=targets,
        station=station,
        target=target,
        face=face,
        repeat=repeat,
        time=time,
        readings=measured * [MILLIMETRE, DEGREE, DEGREE],
        covariates=covariates,
        labels=labels,
        has_clock="time_s" in columns,
    )
    if not is_growing:
        _require_valid_gauge(recording, folder / SETUP_FILE)
        check_reference_difference_ends(recording, folder / SETUP_FILE)
        check_centring_tables(recording, folder / SETUP_FILE)
    _require_declared_smrs(recording, folder)
    return recording.replace(notes=_unused_settings_notes(recording))


def _check_header(header: Sequence[str], file: Path) -> None:
    """Check that the header has every required column once, in the unit of the native format; raises RecordError."""
    location = SourceLocation(file, 0)
    if any(";" in name or "\t" in name for name in header):
        raise location.error("the header contains ';' or tabs, expected commas between columns")
    for i, name in enumerate(header):
        location.checked_text(name)
        if not name:
            raise location.error(f"column {i + 1} has no name")
        if name in header[:i]:
            raise location.error("this column appears twice in the header", name)
        stem, _, unit = name.rpartition("_")
        right = next((k for k in COLUMN_VALUE_BOUNDS if k.rpartition("_")[0] == stem and k != name), None)
        if (
            right is not None
            and unit.lower() in (*UNIT_BY_SPELLING, *SI_PER_UNIT, *WRONG_UNIT_SUFFIXES)
            and name not in COLUMN_VALUE_BOUNDS
        ):
            raise location.error(f"the unit '{unit}' is not permitted here, expected the column {right}", name)
    require_columns(header, REQUIRED_COLUMNS, file)


def _integer_column(column: list[str], location: SourceLocation, bounds: tuple[int, int]) -> Ints:
    low, high = bounds
    number_by_text: dict[str, int] = {}
    for text in dict.fromkeys(column):
        if not (text.isascii() and text.isdigit() and len(text) < 8 and low <= int(text) <= high):
            expected = f"{low} or {high}" if high == low + 1 else f"a whole number from {low}"
            raise replace(location, row=column.index(text) + 1).error(
                f"found '{safe_excerpt(text)}', expected {expected}"
            )
        number_by_text[text] = int(text)
    return np.array([number_by_text[text] for text in column], dtype=np.int64)


def _float_column(column: list[str], location: SourceLocation, *, is_optional: bool = True) -> Floats:
    """Numbers (n,) in n cells, within `COLUMN_VALUE_BOUNDS`; an empty cell is NaN if `is_optional`, else an error."""
    low, high = COLUMN_VALUE_BOUNDS.get(location.column or "", (-1e15, 1e15))
    numbers = plain_numbers(column)
    if numbers is not None and np.all(((numbers >= low) & (numbers <= high)) | (is_optional & np.isnan(numbers))):
        return numbers
    numbers = np.full(len(column), np.nan)
    for i, text in enumerate(column):  # to name the first that is wrong
        if is_optional and not text:
            continue
        cell = replace(location, row=i + 1)
        numbers[i] = cell.parse_number(text, limit=1e15)
        if not low <= numbers[i] <= high:
            hint = " (it looks like gon)" if location.column == "elevation_deg" and 270 < numbers[i] < 400 else ""
            raise cell.error(f"found {safe_excerpt(text)}, expected a value from {low:g} to {high:g}{hint}")
    return numbers


def _additional_columns(
    columns: dict[str, list[str]], file: Path
) -> tuple[dict[str, Floats], dict[str, tuple[str, ...]]]:
    """Additional columns by name: covariates (columns of numbers) and labels (columns of texts)."""
    covariates: dict[str, Floats] = {}
    labels: dict[str, tuple[str, ...]] = {}
    for name, column in columns.items():
        if name in STANDARD_COLUMNS:
            continue
        filled = [text for text in column if text]
        numeric = bool(filled) and all(is_number(t) or is_not_finite(t) for t in filled)
        if (numeric or name in COLUMN_VALUE_BOUNDS) and name not in TEXT_COLUMNS:
            covariates[name] = _float_column(column, SourceLocation(file, column=name))
            continue
        for i, text in enumerate(column):
            where = SourceLocation(file, i + 1, name)
            where.checked_text(text)
            if name in ENUMERATED_COLUMNS and text not in ENUMERATED_COLUMNS[name]:
                raise where.error(
                    f"found '{safe_excerpt(text)}', expected {' or '.join(filter(None, ENUMERATED_COLUMNS[name]))}"
                )
        labels[name] = tuple(column)
    return covariates, labels


def _require_valid_gauge(recording: Recording, file: Path) -> None:
    targets = frozenset(recording.targets)
    for i, length in enumerate(recording.gauge.distance):
        for name in (length.from_, length.to):
            if name not in targets:
                near = difflib.get_close_matches(name, recording.targets, n=3, cutoff=0.3)
                hint = f"; similar names are {', '.join(near)}" if near else ""
                where = SourceLocation(file, column=f"gauge.distance {i + 1}")
                raise where.error(f"the target '{safe_excerpt(name)}' was never measured{hint}")
    ReferenceLengths.from_recording(recording, file)


def _require_declared_smrs(recording: Recording, folder: Path) -> None:
    """Check that a declared SMR belongs to each pointing, and a normal to each nest that needs one; raises RecordError.

    A nest needs a normal if its SMR has not the reference radius. Without tables of SMRs nothing is checked.
    """
    excess_radii(recording, folder / SETUP_FILE)
    names = smr_names(recording)
    if recording.setup.reflectors and "" in names:
        row = names.index("")
        target = recording.targets[recording.target[row]]
        message = f"neither this cell nor targets.{target}.reflector names an SMR; expected a name in [reflectors.NAME]"
        raise SourceLocation(folder / OBSERVATIONS_FILE, row + 1, REFLECTOR_COLUMN).error(message)


def _unused_settings_notes(recording: Recording) -> tuple[str, ...]:
    """Notes on settings without effect (tables of unmeasured stations) and on replaced values of data sheets."""
    setup, notes = recording.setup, list[str]()
    stations, targets = frozenset(recording.stations), frozenset(recording.targets)
    marks = Counter(s.over for name, s in setup.stations.items() if s.over and name in stations)
    for name in recording.stations:
        over = recording.station_setup(name).over
        if over and over not in targets and over not in setup.targets and marks[over] == 1:
            notes.append(
                f"stations.{name}.over is '{safe_excerpt(over)}', a mark that no pointing and no other set-up names: "
                f"it has no effect{_similar_names_phrase(over, recording.targets, len(notes))}"
            )
    for name in setup.stations:
        if name not in stations:
            similar = _similar_names_phrase(name, recording.stations, len(notes))
            notes.append(f"station {name} has no pointings: the table stations.{name} has no effect{similar}")
    joined = {name for entry in setup.differences for name in (entry.from_, entry.to)}
    for name, target in setup.targets.items():
        if target.known_mm and name not in targets and name not in marks and name not in joined:
            similar = _similar_names_phrase(name, recording.targets, len(notes))
            notes.append(f"target {name} has known coordinates, but was never measured{similar}")
        elif target.datum and name not in targets and name not in marks:
            notes.append(
                f"target {name} is not used for the datum, because it was never "
                f"measured{_similar_names_phrase(name, recording.targets, len(notes))}"
            )
    for place, entry in {"instrument": setup.instrument, **setup.instruments}.items():
        if keys := keys_deviating_from_data_sheet(entry):
            notes.append(f"{place}: the declared {', '.join(keys)} replace values of the data sheet {entry.sheet}")
    if setup.height_above_mark_sigma_mm is not None and not recording.labels.keys() & {*OCCUPATION_COLUMNS}:
        notes.append(f"height_above_mark_sigma_mm has no effect without a column {' or '.join(OCCUPATION_COLUMNS)}")
    if setup.reference_radius_mm is not None and not setup.reflectors:
        notes.append("reference_radius_mm has no effect without tables [reflectors.NAME] with the radii of SMRs")
    return tuple(notes)


def _similar_names_phrase(name: str, names: Sequence[str], n_notes: int) -> str:
    """End of a note that proposes names similar to `name`; empty if there are none, or too many to compare.

    `n_notes` is the number of earlier notes; `MAX_NAME_COMPARISONS` limits the comparisons of all notes.
    """
    if (n_notes + 1) * len(names) > MAX_NAME_COMPARISONS:
        return ""
    similar = difflib.get_close_matches(name, names, n=3, cutoff=0.5)
    return f"; did you mean {', '.join(similar)}?" if similar else ""


def write_recording(recording: Recording, path: Path) -> None:
    """Writing of a recording into a folder: both files completely, or none.

    Raises RecordError for names or values that could not be read back, and if the folder is not writable.
    """
    if path.exists() and not path.is_dir():
        raise RecordError("the path is a file, expected a folder for the recording", file=path)
    write_texts(path, recording_texts(recording, path))


def recording_texts(recording: Recording, path: Path) -> dict[str, str]:
    """Contents of `observations.csv` and `setup.toml` of a recording, by file name; `path` is named in errors.

    Raises RecordError for names or values that could not be read back.
    """
    (header, columns), toml = observation_table(recording), setup_to_toml(recording.setup, path / SETUP_FILE)
    validate_setup(recording.setup.model_dump(by_alias=True, mode="json", exclude_none=True), path / SETUP_FILE)
    parse_observations((header, columns), recording.setup, path)
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    return {OBSERVATIONS_FILE: stream.getvalue(), SETUP_FILE: toml}


def observation_table(recording: Recording) -> TextTable:
    """Column names and columns of the `observations.csv` of a recording."""
    readings = recording.readings
    columns: dict[str, Sequence[str]] = {
        "station": [escape_cell_text(recording.stations[i]) for i in recording.station],
        "target": [escape_cell_text(recording.targets[i]) for i in recording.target],
        "face": _integer_texts(recording.face),
        "repeat": _integer_texts(recording.repeat),
    }
    if recording.has_clock:
        columns["time_s"] = _number_texts(recording.time)
    columns["azimuth_deg"] = _number_texts(readings[:, 1], DEGREE, 9)
    columns["elevation_deg"] = _number_texts(readings[:, 2], DEGREE, 9)
    columns["distance_mm"] = _number_texts(readings[:, 0], MILLIMETRE, 6)
    columns |= {name: _number_texts(values) for name, values in recording.covariates.items()}
    columns |= {name: [escape_cell_text(text) for text in labels] for name, labels in recording.labels.items()}
    return list(map(escape_cell_text, columns)), list(columns.values())


def _integer_texts(values: Ints) -> list[str]:
    """Integers as texts; equal integers share one string to save memory."""
    distinct, index = np.unique(values, return_inverse=True)
    texts = list(map(str, distinct.tolist()))
    return [texts[i] for i in index]


def _number_texts(si_values: Floats, unit: float = 1.0, digits: int | None = None) -> list[str]:
    """Numbers divided by `unit` as texts, with `digits` decimals if exact, otherwise with all digits; '' for NaN."""
    is_finite = np.isfinite(si_values)
    finite_values = (si_values[is_finite] / unit).tolist()
    texts = list(map(repr, finite_values))
    if digits is not None:
        short = [f"{number:.{digits}f}" for number in finite_values]
        exact = np.array(list(map(float, short))) * unit == si_values[is_finite]
        texts = [
            short_text if is_exact else full_text
            for short_text, full_text, is_exact in zip(short, texts, exact.tolist(), strict=True)
        ]
    remaining_texts = iter(texts)
    return [next(remaining_texts) if finite else "" for finite in is_finite.tolist()]
