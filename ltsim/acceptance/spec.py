"""Acceptance file (ltsim-acceptance/1): tests, the manufacturer's limits, and information on the instrument.

Tests are lengths and two-face targets in the instrument's frame, with z upwards and the origin at the head.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, ModelError, require_columns, reraise_as_input_error
from ltsim.geometry.polar import from_polar
from ltsim.recordings.files import parse_comma_number, safe_excerpt
from ltsim.recordings.settings import read_toml, validate_settings
from ltsim.recordings.setup import Positive, TomlSection
from ltsim.recordings.specification import Specification, completed_specification_values, data_sheet_specification
from ltsim.recordings.spreadsheets.sheets import read_small_table

TestKind = Literal["length", "two-face"]
"""Kind of an acceptance test: `length`, or `two-face` (one target measured in both faces)."""
TEST_TABLE_COLUMNS = ("test", "group", "kind", "x1_mm", "y1_mm", "z1_mm", "x2_mm", "y2_mm", "z2_mm")
"""Names of the columns of a CSV table of acceptance tests that a user writes."""
MIN_REFERENCE_LENGTH = 2.3
"""Smallest reference length [m] that ASME B89.4.19-2006 permits; used for the lengths in front of the instrument."""
CLOSEST_POSITION_DISTANCE = 1.2
"""Distance [m] of the instrument from the reference length in the test at the closest position."""
StandardName = Literal["asme-b89.4.19-2006", "iso-10360-10", "iso-10360-10-two-face"]
"""Name of a standard with built-in acceptance tests."""
TWO_FACE_ONLY_STANDARD: StandardName = "iso-10360-10"
"""Standard of which only the two-face tests are openly published; the user provides its length tests in a CSV table."""


@dataclass(frozen=True)
class AcceptanceTest:
    """Acceptance test of a tracker: a length between two points, or one target measured in both faces."""

    __test__ = False  # a test of a tracker, not one of pytest's
    """False: pytest does not collect this class."""

    name: str
    """Name of the acceptance test."""
    group: str
    """Group of the test, such as the two-face tests or the lengths in one orientation."""
    kind: TestKind
    """Kind of the test: `length` or `two-face`."""
    first_point: tuple[float, float, float]
    """First end of a length, or target of a two-face test, (3,) [m] in the instrument's frame."""
    second_point: tuple[float, float, float]
    """Second end of a length, (3,) [m] in the instrument's frame; in a two-face test equal to `first_point`."""


def asme_tests(height: float, ranges: Sequence[float]) -> list[AcceptanceTest]:
    """Tests of ASME B89.4.19-2006 for an instrument whose head is `height` [m] above the floor.

    * 36 two-face tests: at 1, 3 and 6 m, on the floor, at the head's height and at twice this height, every 90 degrees.
    * 33 lengths: horizontal, vertical and along both diagonals, at 3 and 6 m, every 90 degrees, and one horizontal
      length at the closest position.
    * Lengths along the line of sight from the first of the `ranges` [m] to each of the others.

    Two more lengths, which the user may choose freely, are not included.

    References
    ----------
    Description of the standard in Muralikrishnan, Sawyer, Blackburn, Phillips, Borchardt, Estler, J. Res. NIST 114
    (2009) 21-35. The text of the standard prevails; other tests can be read from a CSV table.
    """
    quarters = (0, 90, 180, 270)
    tests = list(_two_face_tests((1.0, 3.0, 6.0), height, quarters))
    tests.append(_length_test("horizontal", 0.0, CLOSEST_POSITION_DISTANCE, 0))
    for group, tilt in (("horizontal", 0.0), ("vertical", 90.0), ("right diagonal", 45.0), ("left diagonal", 135.0)):
        tests += [_length_test(group, tilt, away, turn) for away in (3.0, 6.0) for turn in quarters]
    near, *others = ranges
    return tests + [
        AcceptanceTest(
            f"line of sight {near:g} to {far:g} m", "line of sight", "length", (near, 0.0, 0.0), (far, 0.0, 0.0)
        )
        for far in others
    ]


def iso_two_face_tests(height: float) -> list[AcceptanceTest]:
    """18 two-face tests of ISO 10360-10: at 1.5 and 6 m, at three heights, every 120 degrees.

    The number of positions and their distances follow the Leica AT500 user manual, 2.8.3 (positions 1 to 9 at 1.5 m, 10
    to 18 at 6 m). The length tests of this standard are read from a CSV table.
    """
    return list(_two_face_tests((1.5, 6.0), height, (0, 120, 240)))


def _two_face_tests(distances: Sequence[float], height: float, azimuths_deg: Sequence[int]) -> Iterator[AcceptanceTest]:
    """Two-face tests at horizontal distances [m]: on the floor, at the head's height [m], and at twice this height."""
    for away in distances:
        for z, where in ((-height, "floor"), (0.0, "level"), (height, "high")):
            for turn in azimuths_deg:
                point = _rotated_about_vertical(np.array([away, 0.0, z]), turn)
                yield AcceptanceTest(f"two-face {away:g} m {where} {turn} deg", "two-face", "two-face", point, point)


def _length_test(test_group: str, tilt_deg: float, distance: float, azimuth_deg: int) -> AcceptanceTest:
    """Test of a reference length, centred at the head's height and perpendicular to the line of sight.

    `distance` [m] and `azimuth_deg` are horizontal distance and azimuth of the centre of the length, `tilt_deg` is the
    angle of the length above the horizontal. `test_group` is the name of the group of the test.
    """
    half_vector = MIN_REFERENCE_LENGTH / 2 * np.array([0.0, np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))])
    midpoint = np.array([distance, 0.0, 0.0])
    ends = (
        _rotated_about_vertical(midpoint - half_vector, azimuth_deg),
        _rotated_about_vertical(midpoint + half_vector, azimuth_deg),
    )
    return AcceptanceTest(f"{test_group} {distance:g} m {azimuth_deg} deg", test_group, "length", *ends)


def _rotated_about_vertical(point: Floats, rotation_deg: float) -> tuple[float, float, float]:
    """Point (3,) [m] after a rotation about the vertical by an angle [deg]."""
    angle = np.radians(rotation_deg)
    x, y, z = point
    return (
        float(x * np.cos(angle) - y * np.sin(angle)),
        float(x * np.sin(angle) + y * np.cos(angle)),
        float(z),
    )


def builtin_tests(standard_name: StandardName, height: float, ranges: Sequence[float]) -> list[AcceptanceTest]:
    """Openly published tests of a standard, for an instrument whose head is `height` [m] above the floor.

    `ranges` [m] are the distances of the points on the line of sight between which lengths are tested.
    """
    return asme_tests(height, ranges) if standard_name == "asme-b89.4.19-2006" else iso_two_face_tests(height)


@reraise_as_input_error()
def read_tests(file: Path) -> list[AcceptanceTest]:
    """Acceptance tests from a user's CSV table with the columns `TEST_TABLE_COLUMNS`.

    In a two-face test the second point is empty. InputError, with row, column, value and the expected value, is raised
    for an invalid table.
    """
    tests = [_test_from_row(row, line, file) for line, row in read_table_rows(file, TEST_TABLE_COLUMNS)]
    if not tests:
        raise InputError(f"{file}: the table has no rows; expected one row for each test")
    return tests


def read_table_rows(file: Path, required_columns: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Line number, and cells by column name, of each row in a user's CSV table; raises RecordError or InputError.

    The table must have the `required_columns`; further columns are permitted.
    """
    header, rows = read_small_table(file)
    with reraise_as_input_error():
        require_columns(header, required_columns, file)
    return rows


def _test_from_row(row: dict[str, str], line_number: int, file: Path) -> AcceptanceTest:
    """Acceptance test from a row of a CSV table; raises InputError with the row for invalid values."""
    kind = row["kind"]
    if kind not in ("length", "two-face"):
        raise InputError(f"{file}: row {line_number}: kind is '{safe_excerpt(kind)}', expected length or two-face")
    first_point = _point_from_row(row, "1", line_number, file)
    second = _point_from_row(row, "2", line_number, file) if kind == "length" else first_point
    if kind == "length" and first_point == second:
        raise InputError(f"{file}: row {line_number}: both ends of the length are the same point")
    name = row["test"] or f"{kind} in line {line_number}"
    return AcceptanceTest(name, row["group"] or kind, kind, first_point, second)  # type: ignore[arg-type]


def _point_from_row(row: dict[str, str], end_name: str, line_number: int, file: Path) -> tuple[float, float, float]:
    """Coordinates (3,) [m] of the first or second point (`end_name` 1 or 2) in a table row; raises InputError."""
    columns = (f"{axis}{end_name}_mm" for axis in "xyz")
    coordinates = [parse_comma_number(row[name], file=file, row=line_number, column=name) / 1000 for name in columns]
    if not np.isfinite(coordinates).all() or np.hypot(coordinates[0], coordinates[1]) < 1e-3:
        raise InputError(
            f"{file}: row {line_number}: point {end_name} is on the vertical axis of the instrument, "
            "where the azimuth is undefined; give a point away from the axis"
        )
    return coordinates[0], coordinates[1], coordinates[2]


def points_around_instrument() -> Floats:
    """Points (180, 3) [m] around an instrument, at which errors that the acceptance tests do not detect are computed.

    Distances are 1.5 to 9 m, elevations -50 to 50 degrees, with a point every 30 degrees of azimuth.
    """
    azimuth, elevation, range_ = np.meshgrid(
        np.radians(np.arange(0, 360, 30)), np.radians((-50, -25, 0, 25, 50)), (1.5, 4.0, 9.0), indexing="ij"
    )
    return from_polar(np.stack([range_.ravel(), azimuth.ravel(), elevation.ravel()], axis=1))


MAX_ACCEPTANCE_TRIALS = 10_000_000
"""Largest number of random draws that an acceptance file may request."""


class AcceptanceSettings(TomlSection):
    """Content of an acceptance file; paths of other files are relative to the folder of this file.

    With `measured_errors_file`, measured errors are evaluated. With `recording`, lengths between the targets of a
    network replace calibrated lengths. Without both, the tests are predicted, for the instrument of `calibration` or
    for any instrument that meets the specification.
    """

    format: Literal["ltsim-acceptance/1"] = "ltsim-acceptance/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the acceptance tests, free text."""
    standard: StandardName | None = None
    """Standard whose built-in tests are used."""
    additional_tests_file: str | None = None
    """CSV file of tests in addition to the built-in ones, one row for each test; required for the lengths of
    `iso-10360-10`.
    """
    tests_file: str | None = None
    """CSV file of tests in place of the built-in ones, one row for each test."""
    instrument: str | None = None
    """Name of the instrument's built-in data sheet."""
    specification: Specification | None = None
    """Manufacturer's limits. If `instrument` is given too, these limits complete or replace the values of its data
    sheet."""
    construction: Literal["source-in-head", "steering-mirror"] = "source-in-head"
    """Design of the instrument: beam source in the head, or a steering mirror."""
    height_mm: Positive = 1500.0
    """Height of the instrument's head above the floor [mm]; the targets of two-face tests are on the floor, at this
    height and at twice this height.
    """
    ranges_m: Annotated[tuple[Positive, ...], Field(min_length=2)] = (2.0, 6.0, 12.0, 18.0, 24.0, 30.0)
    """Distances [m] of points on the line of sight; lengths are tested from the first point to each of the others."""
    calibration: str | None = None
    """Calibration of the instrument: path of a `calibration.json` or of its folder."""
    corrected: bool = False
    """True if the readings are corrected by `calibration` before the tests, so that only the uncertainty of the
    calibration remains."""
    recording: str | None = None
    """Path of the recording of a network that the instrument measured; its targets provide the reference lengths."""
    measured_errors_file: str | None = None
    """CSV file of measured errors with the columns test, error_um and U_um (expanded uncertainty, may be empty)."""
    trials: Annotated[int, Field(ge=1000, le=MAX_ACCEPTANCE_TRIALS)] = 20_000
    """Number of random draws with which the probability to pass is estimated."""
    seed: Annotated[int, Field(ge=0)] = 0
    """Seed of the random draws."""

    @model_validator(mode="after")
    def _check_complete(self) -> Self:
        """Check that the keys of the file are complete and do not exclude each other; raises ValueError."""
        if self.instrument is None and self.specification is None:
            raise ValueError("give the key instrument or the table [specification]")
        if self.recording is None and (self.standard is None) == (self.tests_file is None):
            raise ValueError("give either standard or tests_file")
        if self.standard == TWO_FACE_ONLY_STANDARD and self.additional_tests_file is None:
            raise ValueError(
                "give additional_tests_file = FILE, because the length tests of iso-10360-10 are not built in"
            )
        if self.additional_tests_file is not None and self.standard is None:
            raise ValueError("give additional_tests_file only with a standard, because tests_file contains all tests")
        if self.recording is not None and self.measured_errors_file is not None:
            raise ValueError("give recording or measured_errors_file, not both")
        return self

    @property
    def specification_or_data_sheet(self) -> Specification:
        """Manufacturer's specification; raises InputError for an unknown data sheet or a missing limit."""
        if self.specification is not None:
            return self.specification
        try:
            return data_sheet_specification(self.instrument or "")
        except ModelError as problem:
            raise InputError(str(problem)) from None

    @property
    def plan_name(self) -> str:
        """Name of the plan of tests: the standard, or the file with the tests."""
        return self.tests_file or self.standard or ""

    def make_tests(self, folder: Path) -> tuple[AcceptanceTest, ...]:
        """Tests of the standard and of the files of tests in `folder`; raises InputError for an invalid file."""
        if self.standard is None:
            return tuple(read_tests(folder / (self.tests_file or "")))
        user_tests = [] if self.additional_tests_file is None else read_tests(folder / self.additional_tests_file)
        return (*builtin_tests(self.standard, self.height_mm / 1000, self.ranges_m), *user_tests)


@reraise_as_input_error()
def load_acceptance(path: Path) -> AcceptanceSettings:
    """Content of the acceptance file at a path; raises InputError."""
    return validate_acceptance(read_toml(path, "acceptance file"), path)


@reraise_as_input_error()
def validate_acceptance(tables: Mapping[str, Any], file: object) -> AcceptanceSettings:
    """Validated content of an acceptance file from its TOML tables; raises InputError, which names `file`."""
    name, specification = tables.get("instrument"), tables.get("specification", {})
    if isinstance(name, str) and isinstance(specification, Mapping):
        try:
            tables = {**tables, "specification": completed_specification_values(name, specification)}
        except ModelError as problem:
            raise InputError(f"{file}: {problem}") from None
    return validate_settings(tables, AcceptanceSettings, "acceptance file", file)
