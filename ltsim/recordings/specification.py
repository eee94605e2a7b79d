"""Noise of instruments: from maximum permissible errors (MPE) of data sheets, or a default by kind of instrument."""

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
"""Maximum permissible error divided by the standard deviation that is derived from it: manufacturers specify a typical
error of half the maximum."""
TWO_FACE_TO_TRANSVERSE_LIMIT_RATIO = 2.0
"""Limit of a two-face difference divided by the limit of the error of a point perpendicular to the beam (ISO
10360-10:2021, 6.3 and annex D).
"""
REQUIRED_LIMIT_KEYS = ("transverse_limit_um", "transverse_limit_um_per_m", "range_limit_um", "range_limit_um_per_m")
"""Keys of a specification that must be given, because acceptance tests have no limit without them."""
RANGE_KEY_PREFIXES = ("distance_", "range_")
"""Beginnings of the keys of noise and prior that follow from the limits of range errors."""

TOTAL_STATION_NOISE = Noise(distance_mm=1.0, distance_ppm=1.5, azimuth_arcsec=1.0, elevation_arcsec=1.0)
"""Standard deviations of a first-class total station by ISO 17123, as in manufacturers' data sheets."""
TOTAL_STATION = Instrument(noise=TOTAL_STATION_NOISE, corrected=True)
"""Instrument that is assumed for files of total stations; its readings are already corrected."""
ASSUMED_NOISE_TEXT = "the file declares no noise"
"""Beginning of a note that reports an assumed noise."""
NO_NOISE_NOTE = (
    f"{ASSUMED_NOISE_TEXT}: the noise of the default laser tracker is used (3 um + 0.3 ppm, 0.37 arcsec); set it in "
    "setup.toml, or estimate it from the readings (--noise-from-data)"
)
"""Note to the user on the assumed noise of a tracker."""
TOTAL_STATION_NOTE = (
    ASSUMED_NOISE_TEXT + ": the noise of a total station is used ({distance:g} mm + {ppm:g} ppm, {angle:g} arcsec), "
    "because {reason}; set it in setup.toml, or estimate it from the readings (--noise-from-data)"
)
"""Note to the user on the assumed noise of a total station, as a template with the noise and the reason to fill in."""


def has_assumed_noise(notes: Iterable[str]) -> bool:
    """True if one of the notes of a recording reports that its noise is assumed, because its file declares none."""
    return any(note.startswith(ASSUMED_NOISE_TEXT) for note in notes)


def noise_origin(notes: Iterable[str]) -> str:
    """Origin of the noise of a recording with these notes, as an adjective: `assumed` or `declared`."""
    return "assumed" if has_assumed_noise(notes) else "declared"


class Specification(TomlSection):
    """Maximum permissible errors of an instrument, as in data sheets and in ISO 10360-10:2021, annex D."""

    name: str = ""
    """Name of the instrument."""
    source: str = ""
    """Source of the numbers, such as the title of a data sheet."""
    transverse_limit_um: NonNegative
    """Limit of the error of a point perpendicular to the beam, constant part (e_T)."""
    transverse_limit_um_per_m: NonNegative
    """Limit of the error of a point perpendicular to the beam, part proportional to the range."""
    range_limit_um: NonNegative
    """Limit of the range error, constant part (e_ADM or e_IFM)."""
    range_limit_um_per_m: NonNegative
    """Limit of the range error, part proportional to the range."""
    range_offset_limit_um: NonNegative = 0.0
    """Limit of the range zero error (e_R0)."""
    noise_variance_fraction: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.5
    """Fraction of the variance that is noise; the rest is due to errors of the instrument parameters."""

    @model_validator(mode="after")
    def _check_positive_limits(self) -> Self:
        for kind in ("transverse", "range"):
            if not getattr(self, f"{kind}_limit_um") and not getattr(self, f"{kind}_limit_um_per_m"):
                raise ValueError(f"it should not be 0 in both {kind}_limit_um and {kind}_limit_um_per_m")
        return self

    def transverse_limit(self, range_: Floats) -> Floats:
        """Limit (k,) [m] of the error of a point perpendicular to the beam, at k ranges (k,) [m]."""
        return (self.transverse_limit_um + self.transverse_limit_um_per_m * range_) * MICROMETRE

    def range_limit(self, range_: Floats) -> Floats:
        """Limit (k,) [m] of the error of a point along the beam, at k ranges (k,) [m], without the range zero error."""
        return (self.range_limit_um + self.range_limit_um_per_m * range_) * MICROMETRE

    def length_limits(self, first_points: Floats, second_points: Floats) -> Floats:
        """Limit (k,) [m] of the errors of k lengths between `first_points` and `second_points` (k, 3) [m].

        Points are in the instrument's frame. The limit is the root sum of squares of the limits at both ends, in the
        direction of the length. The range zero error is the same at both ends and cancels if both are on one line of
        sight.
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
        """Limit (k,) [m] of the distance perpendicular to the beam between both faces of k points (k, 3) [m]."""
        return TWO_FACE_TO_TRANSVERSE_LIMIT_RATIO * self.transverse_limit(to_polar(points)[:, 0])

    def to_instrument(self, construction: str = "source-in-head") -> Instrument:
        """Instrument whose noise and priors correspond to these limits, each `MPE_COVERAGE_FACTOR` standard deviations.

        The part of each limit that grows with the range is an angle or a scale, the constant part an offset. Of each
        variance `noise_variance_fraction` is noise of the readings, the rest the prior variance of instrument
        parameters, of which two angular ones act on each direction perpendicular to the beam. The constant part of the
        limit perpendicular to the beam is all prior of offsets, without noise. The constant part of the range limit is
        all noise if the range zero has its own limit.
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
    def assumption_sentence(self) -> str:
        """Sentence on how the limits of the data sheet become standard deviations."""
        return (
            f"each limit of the data sheet is taken as {MPE_COVERAGE_FACTOR:g} standard deviations, "
            f"{100 * self.noise_variance_fraction:g} % of the variance as noise of the readings and the rest as errors "
            "of the instrument parameters"
        )


def _clip_to_min_sigma(sigma: float) -> float:
    return max(float(sigma), 1e-6)


def data_sheet_names() -> tuple[str, ...]:
    """Names of the built-in data sheets."""
    return tuple(_data_sheets())


def data_sheet_values(name: str) -> dict[str, Any]:
    """Values of a built-in data sheet by key of a `Specification`; keys that the sheet does not give are missing.

    Raises ModelError if there is no such sheet.
    """
    if name not in _data_sheets():
        raise unknown_name_error("data sheet", name, _data_sheets())
    return dict(_data_sheets()[name])


def completed_specification_values(name: str, declared_values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a `Specification` by key: those that the user declares, and for other keys those of a data sheet.

    `name` is that of a built-in data sheet. Raises ModelError if there is no such sheet, or neither source gives a
    required limit.
    """
    keys = data_sheet_values(name)
    missing = [key for key in REQUIRED_LIMIT_KEYS if key not in keys and key not in declared_values]
    if missing:
        message = f"the data sheet {name} does not give {' and '.join(missing)}"
        raise ModelError(f"{message}; set {'it' if len(missing) == 1 else 'them'} in the table [specification]")
    if declared_values:
        keys["source"] += f"; not from the data sheet: {', '.join(declared_values)}"
    return {**keys, **declared_values}


def data_sheet(name: str) -> Specification:
    """Specification from a built-in data sheet; raises ModelError if the sheet does not give all required limits."""
    return Specification.model_validate(completed_specification_values(name, {}))


def noise_and_prior_tables(
    name: str, declared_tables: Mapping[str, Any], limit_keys: Iterable[str] = ()
) -> dict[str, dict[str, float]]:
    """Tables ``noise`` and ``prior`` from a built-in data sheet.

    `name` is that of the data sheet, `declared_tables` are the tables of the instrument in the user's file. These must
    contain the values that the sheet does not give, and the keys `limit_keys` of the table ``limits``, because no
    built-in sheet gives the range of elevations.

    Raises ModelError if there is no such sheet, or such a value is missing.
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
            raise ModelError(f"the data sheet {name} does not give the error of ranges; set {', '.join(missing)}")
    declared_limits = declared_tables.get("limits")
    missing_limits = [
        f"limits.{key}" for key in limit_keys if not isinstance(declared_limits, Mapping) or key not in declared_limits
    ]
    if missing_limits:
        raise ModelError(
            f"the data sheet {name} does not give the travel of the elevation axis; set {', '.join(missing_limits)}"
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
    text = Path(__file__).with_name("sheets.csv").read_text(encoding="utf-8")
    return {row["name"]: _values_from_row(row) for row in csv.DictReader(text.splitlines())}


def _values_from_row(row: dict[str, str]) -> dict[str, Any]:
    number_by_key = {
        key: float(text) for key, text in row.items() if text and key not in ("name", "instrument", "source")
    }
    return {"name": row["instrument"], "source": row["source"], **number_by_key}
