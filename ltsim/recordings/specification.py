"""Noise of instruments, from maximum permissible errors (MPE) in data sheets or from a default for total stations."""

import csv
import functools
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, unknown_name_error
from ltsim.core.units import ARCSECOND, MICROMETRE, MILLIMETRE
from ltsim.geometry.polar import to_polar
from ltsim.recordings.setup import Instrument, Noise, NonNegative, Prior, TomlSection

MPE_COVERAGE_FACTOR = 2.0
"""Maximum permissible error divided by the standard deviation that is derived from it: 2, because manufacturers specify
typical errors of half the maximum."""
TWO_FACE_TO_TRANSVERSE_LIMIT_RATIO = 2.0
"""Limit of a two-face difference, divided by the limit of the error of a point across the beam (ISO 10360-10:2021, 6.3
and annex D)."""
REQUIRED_LIMIT_KEYS = ("transverse_limit_um", "transverse_limit_um_per_m", "range_limit_um", "range_limit_um_per_m")
"""Keys that each specification must have: without these limits an acceptance test has no criterion."""
RANGE_KEY_PREFIXES = ("distance_", "range_")
"""Beginnings of the keys of noise and prior that are derived from the limits of range errors."""

ASSUMED_TOTAL_STATION_NOISE = Noise(distance_mm=1.0, distance_ppm=1.5, azimuth_arcsec=1.0, elevation_arcsec=1.0)
"""Standard deviations of a precise total station by ISO 17123, as in data sheets."""
ASSUMED_TOTAL_STATION = Instrument(noise=ASSUMED_TOTAL_STATION_NOISE, corrected=True)
"""Instrument that is assumed for files of total stations; the readings are already corrected for its errors."""
ASSUMED_NOISE_NOTE_BEGINNING = "the file declares no noise"
"""Beginning of each note that reports an assumed noise."""
ASSUMED_TRACKER_NOISE_NOTE = (
    f"{ASSUMED_NOISE_NOTE_BEGINNING}: the default noise of a laser tracker is used (3 um + 0.3 ppm, 0.37 arcsec); "
    "set it in setup.toml, or estimate it from the readings (--noise-from-data)"
)
"""Note for the user that the default noise of a laser tracker is assumed."""
ASSUMED_TOTAL_STATION_NOISE_NOTE = (
    ASSUMED_NOISE_NOTE_BEGINNING
    + ": the default noise of a total station is used ({distance:g} mm + {ppm:g} ppm, {angle:g} arcsec), "
    "because {reason}; set it in setup.toml, or estimate it from the readings (--noise-from-data)"
)
"""Note for the user that the noise of a total station is assumed; the text has fields for the noise and the reason."""


def has_assumed_noise(notes: Iterable[str]) -> bool:
    """True if one of the `notes` of a recording reports that its noise is assumed, because the file declares none."""
    return any(note.startswith(ASSUMED_NOISE_NOTE_BEGINNING) for note in notes)


def noise_origin(notes: Iterable[str]) -> str:
    """Word for the origin of the noise of a recording with these `notes`: `assumed` or `declared`."""
    return "assumed" if has_assumed_noise(notes) else "declared"


class Specification(TomlSection):
    """Maximum permissible errors of an instrument (limits), as in data sheets and in ISO 10360-10:2021, annex D."""

    name: str = ""
    """Name of the instrument."""
    source: str = ""
    """Source of the limits, such as the title of a data sheet."""
    transverse_limit_um: NonNegative
    """Limit of the error of a point across the beam, constant part (e_T)."""
    transverse_limit_um_per_m: NonNegative
    """Limit of the error of a point across the beam, part proportional to the range."""
    range_limit_um: NonNegative
    """Limit of the range error, constant part (e_ADM or e_IFM)."""
    range_limit_um_per_m: NonNegative
    """Limit of the range error, part proportional to the range."""
    range_offset_limit_um: NonNegative = 0.0
    """Limit of the range zero error (e_R0)."""
    noise_variance_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Fraction of the variance derived from each limit that is noise of readings; the rest is the prior variance of
    instrument parameters.
    """

    @model_validator(mode="after")
    def _check_positive_limits(self) -> Self:
        for kind in ("transverse", "range"):
            if not getattr(self, f"{kind}_limit_um") and not getattr(self, f"{kind}_limit_um_per_m"):
                raise ValueError(f"{kind}_limit_um and {kind}_limit_um_per_m should not both be 0")
        return self

    def transverse_limit(self, range_: Floats) -> Floats:
        """Limit (k,) [m] of the error of a point across the beam, at k ranges `range_` (k,) [m]."""
        return (self.transverse_limit_um + self.transverse_limit_um_per_m * range_) * MICROMETRE

    def range_limit(self, range_: Floats) -> Floats:
        """Limit (k,) [m] of the error of a point along the beam, at k ranges `range_` (k,) [m], without zero error."""
        return (self.range_limit_um + self.range_limit_um_per_m * range_) * MICROMETRE

    def length_limits(self, first_points: Floats, second_points: Floats) -> Floats:
        """Limit (k,) [m] of the errors of k lengths between `first_points` (k, 3) and `second_points` (k, 3) [m].

        Points are in the frame of the instrument. The limit is the root sum of squares of the limits at both ends,
        projected to the direction of the length. The zero error of ranges is equal at both ends, and cancels if the
        length is along a line of sight.
        """
        difference = second_points - first_points
        direction = difference / np.linalg.norm(difference, axis=1, keepdims=True)
        squares, offset = np.zeros(len(difference)), np.zeros(len(difference))
        for points, sign in ((first_points, -1.0), (second_points, 1.0)):
            range_ = to_polar(points)[:, 0]
            cosine = np.einsum("ki,ki->k", direction, points) / range_
            squares += (cosine * self.range_limit(range_)) ** 2 + (1 - cosine**2) * self.transverse_limit(range_) ** 2
            offset += sign * cosine
        return np.sqrt(squares + (offset * self.range_offset_limit_um * MICROMETRE) ** 2)

    def two_face_limits(self, points: Floats) -> Floats:
        """Limit (k,) [m] of the distance, across the beam, between the results in both faces at k points (k, 3) [m]."""
        return TWO_FACE_TO_TRANSVERSE_LIMIT_RATIO * self.transverse_limit(to_polar(points)[:, 0])

    def to_instrument(self, construction: str = "source-in-head") -> Instrument:
        """Instrument with the noise and prior that follow from the limits, each taken as `MPE_COVERAGE_FACTOR` sigmas.

        The part of a limit that grows with the range is an angle or a scale, the constant part an offset. The fraction
        `noise_variance_fraction` of each variance is noise of readings, the rest is the prior variance of instrument
        parameters. Two angular parameters act in each direction across the beam and share this rest. There are two
        exceptions: the constant part across the beam is all prior of offsets, and the constant part of the range limit
        is all noise if the zero error has a separate limit.
        """
        sigma = 1.0 / MPE_COVERAGE_FACTOR
        noise_factor, constants_factor = (
            np.sqrt(self.noise_variance_fraction),
            np.sqrt(1 - self.noise_variance_fraction),
        )
        angle = sigma * self.transverse_limit_um_per_m * MICROMETRE / ARCSECOND
        has_offset = self.range_offset_limit_um > 0
        offset = self.range_offset_limit_um if has_offset else constants_factor * self.range_limit_um
        range_noise_factor = 1.0 if has_offset else noise_factor
        return Instrument(
            construction=construction,  # type: ignore[arg-type]
            noise=Noise(
                distance_mm=sigma * range_noise_factor * self.range_limit_um * MICROMETRE / MILLIMETRE,
                distance_ppm=sigma * self.range_limit_um_per_m * noise_factor,
                azimuth_arcsec=_clip_to_min_sigma(angle * noise_factor),
                elevation_arcsec=_clip_to_min_sigma(angle * noise_factor),
            ),
            prior=Prior(
                range_scale_ppm=_clip_to_min_sigma(sigma * self.range_limit_um_per_m * constants_factor),
                range_offset_mm=_clip_to_min_sigma(sigma * offset * MICROMETRE / MILLIMETRE),
                angle_arcsec=_clip_to_min_sigma(angle * constants_factor / np.sqrt(2.0)),
                offset_mm=_clip_to_min_sigma(sigma * self.transverse_limit_um * MICROMETRE / MILLIMETRE),
            ),
        )

    @property
    def limit_interpretation_sentence(self) -> str:
        """Sentence that says how the limits of the data sheet become standard deviations."""
        return (
            f"each limit of the data sheet is taken as {MPE_COVERAGE_FACTOR:g} standard deviations, "
            f"{100 * self.noise_variance_fraction:g} % of the variance as noise of the readings and the rest as errors "
            "of the instrument parameters"
        )


def _clip_to_min_sigma(sigma: float) -> float:
    """Standard deviation of at least 1e-6, the smallest value that a set-up may have."""
    return max(float(sigma), 1e-6)


def data_sheet_names() -> tuple[str, ...]:
    """Names of the built-in data sheets."""
    return tuple(_data_sheets())


def data_sheet_values(name: str) -> dict[str, Any]:
    """Values of a built-in data sheet, by key of `Specification`, without keys for which the sheet has no value.

    Raises ModelError if there is no data sheet with this name.
    """
    if name not in _data_sheets():
        raise unknown_name_error("data sheet", name, _data_sheets())
    return dict(_data_sheets()[name])


def completed_specification_values(name: str, declared_values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by key of `Specification`: `declared_values` of the user, completed by the built-in data sheet `name`.

    Raises ModelError if there is no such data sheet, or if neither source has a required limit.
    """
    keys = data_sheet_values(name)
    missing = [key for key in REQUIRED_LIMIT_KEYS if key not in keys and key not in declared_values]
    if missing:
        message = f"the data sheet {name} does not give {' and '.join(missing)}"
        raise ModelError(f"{message}; set {'it' if len(missing) == 1 else 'them'} in the table [specification]")
    if declared_values:
        keys["source"] += f"; not from the data sheet: {', '.join(declared_values)}"
    return {**keys, **declared_values}


def data_sheet_specification(name: str) -> Specification:
    """Specification from the built-in data sheet `name`; raises ModelError if the sheet lacks a required limit."""
    return Specification.model_validate(completed_specification_values(name, {}))


def noise_and_prior_tables(
    name: str, declared_tables: Mapping[str, Any], limit_keys: Iterable[str] = ()
) -> dict[str, dict[str, float]]:
    """Tables ``noise`` and ``prior`` of an instrument, derived from the built-in data sheet `name`.

    `declared_tables` are the tables of the instrument in the user's file. They must contain the values that the sheet
    lacks, and the keys `limit_keys` of the table ``limits``, because no built-in sheet has the range of elevations.

    Raises ModelError if there is no such data sheet, or if such a value is missing.
    """
    figures = data_sheet_values(name)
    specification = Specification.model_validate({**dict.fromkeys(REQUIRED_LIMIT_KEYS, 1.0), **figures}).to_instrument()
    unrounded_tables = {
        "noise": specification.noise.model_dump(),
        "prior": specification.prior.model_dump(exclude={"parameters"}),
    }
    tables = {
        table: {key: float(f"{x:.6g}") for key, x in values.items()} for table, values in unrounded_tables.items()
    }
    if any(key not in figures for key in REQUIRED_LIMIT_KEYS):
        declared = {
            f"{table}.{key}"
            for table in tables
            if isinstance(declared_tables.get(table), Mapping)
            for key in declared_tables[table]
        }
        range_keys = [
            f"{table}.{key}" for table, values in tables.items() for key in values if key.startswith(RANGE_KEY_PREFIXES)
        ]
        missing = [key for key in range_keys if key not in declared]
        if missing:
            raise ModelError(f"the data sheet {name} does not give errors of ranges; set {', '.join(missing)}")
    declared_limits = declared_tables.get("limits")
    missing_limits = [
        f"limits.{key}" for key in limit_keys if not isinstance(declared_limits, Mapping) or key not in declared_limits
    ]
    if missing_limits:
        raise ModelError(
            f"the data sheet {name} does not give limits of elevations and ranges; "
            f"set {', '.join(missing_limits)} in the table [instrument]"
        )
    return tables


def keys_deviating_from_data_sheet(instrument: Instrument) -> list[str]:
    """Keys of ``noise`` and ``prior``, such as ``noise.distance_mm``, whose values differ from the data sheet."""
    if instrument.sheet is None:
        return []
    declared_tables: dict[str, dict[str, float]] = instrument.model_dump(include={"noise", "prior"})
    skipped_prefixes = (
        () if all(key in data_sheet_values(instrument.sheet) for key in REQUIRED_LIMIT_KEYS) else RANGE_KEY_PREFIXES
    )
    return [
        f"{table}.{key}"
        for table, values in noise_and_prior_tables(instrument.sheet, declared_tables).items()
        for key, value in values.items()
        if not np.isclose(declared_tables[table][key], value, rtol=1e-5) and not key.startswith(skipped_prefixes)
    ]


@functools.cache
def _data_sheets() -> dict[str, dict[str, Any]]:
    """Values of all built-in data sheets, by name of the sheet."""
    text = Path(__file__).with_name("sheets.csv").read_text(encoding="utf-8")
    return {row["name"]: _values_from_row(row) for row in csv.DictReader(text.splitlines())}


def _values_from_row(row: dict[str, str]) -> dict[str, Any]:
    """Values of a data sheet by key of `Specification`, from its row in the file of built-in sheets."""
    number_by_key = {
        key: float(text) for key, text in row.items() if text and key not in ("name", "instrument", "source")
    }
    return {"name": row["instrument"], "source": row["source"], **number_by_key}
