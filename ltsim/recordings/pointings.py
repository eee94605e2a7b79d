"""Assembly of a recording from pointings, or single observations, that the reader of another format collects."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.errors import RecordError
from ltsim.core.units import MILLIMETRE
from ltsim.recordings.files import SourceLocation
from ltsim.recordings.recording import (
    DISTANCE_KIND_COLUMN,
    HEIGHT_COLUMNS,
    OBSERVABLE_NAMES_WITH_UNIT,
    OBSERVABLES,
    SIGMA_COLUMNS,
    SIGMA_UNITS,
    Recording,
    repeat_numbers,
)
from ltsim.recordings.setup import Setup

NOT_MEASURED = float("nan")
"""Value of a reading that was not measured (NaN)."""
ObservationKind = Literal["distance", "azimuth", "elevation"]
"""Kind of a single observation."""
_SIGMA_UNIT_BY_KIND = dict(zip(OBSERVABLES, SIGMA_UNITS, strict=True))
"""Unit, as SI value, of the column of standard deviations for each kind of observation."""


@dataclass(frozen=True, slots=True)
class Pointing:
    """Pointing from a station to a target: face, range [m], azimuth and elevation [rad], time [s]; NaN if not measured.

    `covariates` and `labels` are the numbers and the texts in additional columns, by name. `source` is the file and the
    line.
    """

    station: str
    target: str
    face: int
    distance: float = NOT_MEASURED
    azimuth: float = NOT_MEASURED
    elevation: float = NOT_MEASURED
    time: float = NOT_MEASURED
    covariates: dict[str, float] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    source: str = ""


@dataclass(frozen=True)
class PointingColumns:
    """Columns of n pointings: names, faces, readings (n, 3) [m, rad, rad], times [s], and additional columns by name.

    Readings and times are NaN if not measured. `covariates` are columns of numbers, `labels` columns of texts,
    `sources` the file and line of each pointing.
    """

    station: Sequence[str]
    target: Sequence[str]
    face: Ints
    readings: Floats
    time: Floats
    covariates: Mapping[str, Floats]
    labels: Mapping[str, Sequence[str]]
    sources: Sequence[str]


def numbered_name(name: str, n_earlier: int) -> str:
    """Unique name of a repeated item, such as a set-up on one mark: `name`, then `name#2`, `name#3` and so on.

    `n_earlier` is the number of earlier items with this name.
    """
    return f"{name}#{n_earlier + 1}" if n_earlier else name


def numbered_names(names: Iterable[str]) -> list[str]:
    """Unique names of items with given `names`; repeated names get numbers."""
    counts: Counter[str] = Counter()
    unique_names = []
    for name in names:
        unique_names.append(numbered_name(name, counts[name]))
        counts[name] += 1
    return unique_names


def index_names(names: Iterable[str], kind: str, file: object) -> tuple[tuple[str, ...], Ints]:
    """Distinct names in order of first occurrence, and the index (n,) of each of the n `names` among them.

    `kind` is "station" or "target". Raises RecordError, which names `file`, for a name that is not permitted.
    """
    index_by_name: dict[str, int] = {}
    index = []
    for row, name in enumerate(names):
        if name not in index_by_name:
            index_by_name[SourceLocation(file, row + 1).checked_name(name, kind, kind)] = len(index_by_name)
        index.append(index_by_name[name])
    return tuple(index_by_name), np.array(index, dtype=np.int64)


def has_all_sigma_columns(recording: Recording) -> bool:
    """True if columns of the recording give the standard deviation of every reading."""
    sigmas = np.full((len(recording), len(SIGMA_COLUMNS)), NOT_MEASURED)
    for k, name in enumerate(SIGMA_COLUMNS):
        sigmas[:, k] = recording.covariates.get(name, NOT_MEASURED)
    return bool(np.isfinite(sigmas[recording.is_measured]).all())


def readings_of_pointings(pointings: Sequence[Pointing]) -> Floats:
    """Range, azimuth and elevation (n, 3) [m, rad, rad] of n pointings."""
    values = (value for p in pointings for value in (p.distance, p.azimuth, p.elevation))
    return np.fromiter(values, dtype=np.float64, count=3 * len(pointings)).reshape(-1, 3)


def recording_from_pointings(
    pointings: Sequence[Pointing], setup: Setup, *, notes: Sequence[str] = (), file: object = None
) -> Recording:
    """Recording of pointings in the given order; repeated ones (same station, target and face) are numbered.

    Raises RecordError for no pointings, a pointing without reading, or a name that is not permitted; errors name
    `file`.
    """
    if not pointings:
        raise RecordError("the file contains no pointings", file=file)
    covariate_names = dict.fromkeys(name for p in pointings for name in p.covariates)
    label_names = dict.fromkeys(name for p in pointings for name in p.labels)
    columns = PointingColumns(
        [p.station for p in pointings],
        [p.target for p in pointings],
        np.array([p.face for p in pointings], dtype=np.int64),
        readings_of_pointings(pointings),
        np.array([p.time for p in pointings]),
        {name: np.array([p.covariates.get(name, NOT_MEASURED) for p in pointings]) for name in covariate_names},
        {name: [p.labels.get(name, "") for p in pointings] for name in label_names},
        [p.source for p in pointings],
    )
    return recording_from_columns(columns, setup, notes=notes, file=file)


def recording_from_columns(
    columns: PointingColumns, recording_setup: Setup, *, notes: Sequence[str] = (), file: object = None
) -> Recording:
    """Recording from columns of pointings; repeated ones (same station, target and face) are numbered.

    `recording_setup` is its set-up, `notes` are sentences for the user. Raises RecordError, which names `file`, for a
    pointing without reading and for a name that is not permitted.
    """
    stations, station = index_names(columns.station, "station", file)
    targets, target = index_names(columns.target, "target", file)
    empty_rows = np.flatnonzero(np.all(np.isnan(columns.readings), axis=1))
    if len(empty_rows):
        raise RecordError("the row contains no reading", file=file, row=int(empty_rows[0]) + 1)
    for texts in columns.labels.values():
        for text in dict.fromkeys(texts):
            SourceLocation(file).checked_text(text)
    has_clock = bool(np.all(np.isfinite(columns.time)))
    return Recording(
        setup=recording_setup,
        stations=stations,
        targets=targets,
        station=station,
        target=target,
        face=columns.face,
        repeat=repeat_numbers(station, target, columns.face),
        time=columns.time if has_clock else np.arange(len(station), dtype=np.float64),
        readings=columns.readings,
        covariates=dict(columns.covariates),
        labels={name: tuple(texts) for name, texts in columns.labels.items()},
        has_clock=has_clock,
        notes=tuple(notes),
        sources=tuple(columns.sources) if all(columns.sources) else (),
    )


@dataclass(frozen=True)
class SingleObservation:
    """Single observation (distance, azimuth or elevation) of a target, with its standard deviation; units m and rad.

    Heights [m] are those above survey marks. Numbers that the file does not give are NaN. `is_horizontal_distance` is
    True for a distance reduced to the horizontal plane; `line` is the number of its line in the file, 0 if unknown.
    """

    kind: ObservationKind
    station: str
    target: str
    value: float
    sigma: float = NOT_MEASURED
    instrument_height: float = NOT_MEASURED
    target_height: float = NOT_MEASURED
    is_horizontal_distance: bool = False
    line: int = 0
    shared_error_shifts: dict[str, float] = field(default_factory=dict)
    """Change of the value [m, rad] by one standard deviation of each error that several observations share, by error
    name."""

    @property
    def heights(self) -> tuple[float, float]:
        """Heights [m] of instrument and reflector above their survey marks."""
        return self.instrument_height, self.target_height


def pointings_from_observations(observations: Iterable[SingleObservation], file: str) -> list[Pointing]:
    """Pointings into which the single observations from each station to each target are combined.

    The k-th azimuth, elevation and distance, if their heights are equal, form one pointing. Standard deviations and
    heights become additional columns. `file` is the file name in the source of each pointing.
    """
    pointing_rows: list[dict[str, SingleObservation]] = []
    open_rows: dict[tuple[str, str], list[dict[str, SingleObservation]]] = {}
    for observation in observations:
        candidates = open_rows.setdefault((observation.station, observation.target), [])
        row = next(
            (r for r in candidates if observation.kind not in r and _have_equal_heights([*r.values(), observation])),
            None,
        )
        if row is None:
            row = {}
            candidates.append(row)
            pointing_rows.append(row)
        row[observation.kind] = observation
        if len(row) == len(OBSERVABLES):
            candidates.remove(row)
    return [_merged_pointing(row, file) for row in pointing_rows]


def _have_equal_heights(observations: Sequence[SingleObservation]) -> bool:
    """True if all given heights of the instrument are equal, and all given heights of the reflector."""
    return all(
        len({h for h in heights if h == h}) < 2 for heights in zip(*(o.heights for o in observations), strict=True)
    )


def _merged_pointing(row: dict[str, SingleObservation], file: str) -> Pointing:
    """Pointing that combines at most one distance, one azimuth and one elevation, given in `row` by kind."""
    sigmas = {SIGMA_COLUMNS[OBSERVABLES.index(kind)]: row[kind].sigma / _SIGMA_UNIT_BY_KIND[kind] for kind in row}
    heights = zip(HEIGHT_COLUMNS, zip(*(o.heights for o in row.values()), strict=True), strict=True)
    shared_columns = {
        f"shared_{name}_{OBSERVABLE_NAMES_WITH_UNIT[OBSERVABLES.index(kind)]}": change / _SIGMA_UNIT_BY_KIND[kind]
        for kind, observation in row.items()
        for name, change in observation.shared_error_shifts.items()
    }
    height_columns = {name: next((h / MILLIMETRE for h in of if h == h), NOT_MEASURED) for name, of in heights}
    is_horizontal_distance = "distance" in row and row["distance"].is_horizontal_distance
    lines = sorted({observation.line for observation in row.values() if observation.line})
    first_observation = next(iter(row.values()))
    return Pointing(
        first_observation.station,
        first_observation.target,
        1,
        **{kind: observation.value for kind, observation in row.items()},
        covariates={
            name: value for name, value in (sigmas | height_columns | shared_columns).items() if value == value
        },
        labels={DISTANCE_KIND_COLUMN: "horizontal"} if is_horizontal_distance else {},
        source=f"{file}, line{'s' * (len(lines) > 1)} {', '.join(map(str, lines))}" if lines else "",
    )


def separate_constant_heights(
    pointings: Sequence[Pointing],
) -> tuple[list[Pointing], dict[str, float], dict[str, float]]:
    """Pointings without constant heights, and these heights [mm] by station (instrument) and by target (reflector).

    If the height of the instrument varies at any station, all instrument heights remain in the pointings, and the
    mapping by station is empty. The heights of reflectors are treated in the same way.
    """
    constant_heights: list[dict[str, float]] = []
    for column, kind in zip(HEIGHT_COLUMNS, ("station", "target"), strict=True):
        values = [(getattr(p, kind), p.covariates[column]) for p in pointings if column in p.covariates]
        height_of = dict(values)
        is_constant = all(height_of[name] == height for name, height in values)
        constant_heights.append({name: height for name, height in height_of.items() if height} if is_constant else {})
        pointings = [
            replace(p, covariates=_without_constant_height(p.covariates, column, is_constant=is_constant))
            for p in pointings
        ]
    return list(pointings), constant_heights[0], constant_heights[1]


def _without_constant_height(covariates: dict[str, float], column: str, *, is_constant: bool) -> dict[str, float]:
    """Covariates of a pointing without a constant height in `column`; a varying height stays (0 if missing)."""
    other_covariates = {name: value for name, value in covariates.items() if name != column}
    return other_covariates if is_constant else {**other_covariates, column: covariates.get(column, 0.0)}
