"""Prior knowledge about a recording: content of `setup.toml` (format ltsim-recording/1).

Names of keys end with the unit of the value; code that needs SI units converts the values.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.centring_errors import CentringUncertainty
from ltsim.recordings.keys import (
    EXACT_LEVELLING_SIGMA_ARCSEC as EXACT_LEVELLING_SIGMA_ARCSEC,
    MIN_SIGMA as MIN_SIGMA,
    Axes as Axes,
    Covariance as Covariance,
    Date as Date,
    Direction as Direction,
    Elevation as Elevation,
    Finite as Finite,
    Height as Height,
    NonNegative as NonNegative,
    Positive as Positive,
    Sigma as Sigma,
    SingleLine as SingleLine,
    TomlSection as TomlSection,
    Vector as Vector,
    symmetric_matrix as symmetric_matrix,
)  # fmt: skip
from ltsim.recordings.report_header import ReportHeader as ReportHeader

MIN_BENCH_ANGLES = 3
"""Smallest number of angles in a bench test: normal incidence, and one angle on each side."""


class Noise(TomlSection):
    """Standard deviations of the white noise of readings; that of a range is distance_mm + distance_ppm * range."""

    distance_mm: NonNegative = 0.003
    """Constant part [mm] of the standard deviation of a range."""
    distance_ppm: NonNegative = 0.3
    """Part of the standard deviation of a range that is proportional to the range."""
    azimuth_arcsec: Sigma = 0.37
    """Standard deviation of an azimuth, measured across the beam. The standard deviation of the azimuth reading is this
    value divided by the cosine of the elevation."""
    elevation_arcsec: Sigma = 0.37
    """Standard deviation of an elevation reading."""

    @model_validator(mode="after")
    def _check_range_noise(self) -> Noise:
        if max(self.distance_mm, self.distance_ppm) < MIN_SIGMA:
            raise ValueError("distance_mm and distance_ppm should not both be 0")
        return self


class Prior(TomlSection):
    """Prior standard deviations of the instrument's parameters, from the manufacturer's specification."""

    range_scale_ppm: Sigma = 2.0
    """Standard deviation of the scale error of ranges (laser frequency and air)."""
    range_offset_mm: Sigma = 0.010
    """Standard deviation of the zero error of ranges."""
    angle_arcsec: Sigma = 3.0
    """Standard deviation of each angular misalignment and each encoder error."""
    offset_mm: Sigma = 0.020
    """Standard deviation of each offset of an axis or of the beam."""
    parameters: dict[str, Positive] = Field(default_factory=dict)
    """Standard deviations of single parameters by name, in the unit of the parameter; they replace the values of the
    other keys."""


class ElevationLimits(TomlSection):
    """Range of elevations that the instrument can measure."""

    elevation_min_deg: Elevation = -55.0
    """Lowest elevation above the horizontal plane that the instrument can measure."""
    elevation_max_deg: Elevation = 77.0
    """Highest elevation above the horizontal plane that the instrument can measure."""

    @model_validator(mode="after")
    def _check_elevation_order(self) -> ElevationLimits:
        if self.elevation_min_deg >= self.elevation_max_deg:
            raise ValueError("elevation_min_deg should be below elevation_max_deg")
        return self


class Instrument(TomlSection):
    """Instrument: design, noise, prior of its parameters, and elevations that it can measure."""

    construction: Literal["source-in-head", "steering-mirror"] = "source-in-head"
    """Design of the beam steering: laser source in the rotating head, or fixed source with a steering mirror."""
    model: SingleLine | None = None
    """Manufacturer and model, such as "Leica AT960", for the header of a report."""
    serial: SingleLine | None = None
    """Serial number, for the header of a report."""
    sheet: SingleLine | None = None
    """Name of a built-in data sheet, which gives the model, the noise and the prior where the file does not."""
    corrected: bool = False
    """True if corrections of the manufacturer, or of an earlier calibration, are already applied to the readings."""
    noise: Noise = Noise()
    """Standard deviations of the white noise of readings."""
    prior: Prior = Prior()
    """Prior standard deviations of the instrument's parameters, from the manufacturer's specification."""
    limits: ElevationLimits | None = None
    """Range of elevations that the instrument can measure; without this table -55 to 77 degrees."""


class Material(TomlSection):
    """Material of reference lengths (scale bars), which share the error of its expansion coefficient."""

    expansion_per_k: Finite = 0.0
    """Coefficient of thermal expansion of the material."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the coefficient of thermal expansion; without it the coefficient is exact."""


class LengthMaterialAndTemperature(TomlSection):
    """Material of a reference length, and temperature of the length during use."""

    measured_at_c: Finite | SingleLine | None = None
    """Temperature of this length during use: a number, or the name of a column of the recording, whose mean over the
    pointings to both ends is used. Default: `measured_at_c` of the table `[gauge]`.
    """
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of the temperature of this length; lengths with the same column share this error. Default:
    `sigma_temperature_k` of the table `[gauge]`.
    """
    material: SingleLine | None = None
    """Name of a table `[gauge.materials.NAME]`; by default the expansion coefficient in `[gauge]` is used."""
    measured_in_place: bool = False
    """True for a length that was measured in the hall during the recording, for example by an interferometer; no
    expansion is computed for it."""


class GaugeDistance(LengthMaterialAndTemperature):
    """Reference length (known distance) between two targets."""

    from_: str = Field(alias="from")
    """Name of the target at the first end of the length."""
    to: str
    """Name of the target at the second end of the length."""
    length_mm: Positive
    """Length at the temperature `calibrated_at_c`, or as measured in the hall if `measured_in_place` is true."""
    sigma_mm: Sigma
    """Standard deviation of `length_mm`."""


class LengthGauge(TomlSection):
    """Reference lengths of a recording, with their temperatures at calibration and during use."""

    calibrated_at_c: Finite = 20.0
    """Temperature at which the reference lengths were calibrated, except those measured in the hall."""
    measured_at_c: Finite | SingleLine = 20.0
    """Temperature of the gauge during use: a number, or the name of a column of the recording."""
    expansion_per_k: Finite = 0.0
    """Coefficient of thermal expansion of all lengths without `material`."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the expansion coefficient of all lengths without `material`, which share this error;
    without it the coefficient is exact.

    """
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of the temperature of the gauge; without it the temperature is exact."""
    sigma_scale_ppm: NonNegative | None = None
    """Standard deviation of a scale error that all lengths share. From 1000 ppm on, the adjustment uses only the ratios
    of lengths."""
    materials: dict[str, Material] | None = None
    """Materials of the reference lengths by name, tables `[gauge.materials.NAME]`."""
    distance: tuple[GaugeDistance, ...] = ()
    """Reference lengths, one table `[[gauge.distance]]` each."""


class Station(TomlSection):
    """Prior knowledge about a station (set-up of an instrument), from the floor plan or a level.

    `over` names the target on whose survey mark the tripod stands. The tracker head is `instrument_height_mm` above the
    mark along `vertical`, the direction of the plumb line in the network frame. It is z by default, and differs between
    the stations of a network of many kilometres, because of the curvature of the earth.
    """

    position_mm: Vector | None = None
    """Approximate position of the tracker head on the floor plan, without weight. The positions of all stations also
    determine the axes of the floor plan in the network frame. Nest normals are given in these axes.
    """
    yaw_deg: Finite | None = None
    """Direction of azimuth zero, counter-clockwise from the x axis (seen from above): an approximate value without
    weight, used if fewer than three stations have `position_mm`.
    """
    yaw_sigma_arcsec: Sigma | None = None
    """Standard deviation of `yaw_deg`, for example of a gyroscope. With it `yaw_deg` of a levelled station is a
    weighted constraint."""
    levelled: bool = False
    """True if the standing axis was levelled; this is a weighted constraint."""
    levelling_sigma_arcsec: Sigma = 1.0
    """Standard deviation of the tilt of a levelled standing axis."""
    instrument: str | None = None
    """Name of the instrument at this station: NAME of a table `[instruments.NAME]`."""
    instrument_height_mm: Height = 0.0
    """Height of the tracker head above the survey mark under it."""
    over: str | None = None
    """Name of the target on whose survey mark the tripod stands."""
    vertical: Direction | None = None
    """Direction of the plumb line in the network frame; default: z."""

    @model_validator(mode="after")
    def _check_orientation(self) -> Station:
        if self.yaw_sigma_arcsec is not None and (self.yaw_deg is None or not self.levelled):
            raise ValueError("yaw_sigma_arcsec needs the keys yaw_deg and levelled = true in this table")
        return self


class Target(TomlSection):
    """Prior knowledge about a target.

    Along `known_axes`, the coordinates `known_mm` have the uncertainty `known_sigma_mm` or `known_covariance_mm2`.
    `approximate_mm` is a start value without weight. All targets with `datum` define the frame together, by inner
    constraints along their `datum_axes` (three targets with "xyz", "yz" and "z" define axes by the 3-2-1 rule).
    """

    nest_normal: Direction | None = None
    """Direction of the normal of the nest, in the axes of the floor plan. The open face of a reflector that is not
    turned points in this direction."""
    reflector: str | None = None
    """Name of the SMR on this target, for pointings without the name of an SMR; targets with one SMR share its errors.
    """
    reaimed: bool = True
    """True for a reflector that is turned towards the station before each pointing."""
    known_mm: Vector | None = None
    """Known coordinates of a control point, used as a weighted constraint."""
    known_sigma_mm: Sigma = 0.01
    """Standard deviation of each known coordinate."""
    known_covariance_mm2: Covariance | None = None
    """Covariance xx, xy, xz, yy, yz, zz of the known coordinates; it replaces `known_sigma_mm`."""
    known_axes: Axes = "xyz"
    """Axes along which the coordinates are known."""
    plan_only: bool = False
    """True for a target of which only the plan coordinates x, y are adjusted; its height is not reported."""
    approximate_mm: Vector | None = None
    """Approximate coordinates: start value of the adjustment, without weight."""
    datum: bool = False
    """True for a target whose coordinates take part in the inner constraints that define the frame."""
    datum_axes: Axes = "xyz"
    """Axes along which the target takes part in the inner constraints."""
    height_mm: Height = 0.0
    """Height of the reflector above the survey mark that has the name of the target."""


class ReferenceDifference(TomlSection):
    """Known vector between two survey marks, for example from levelling (along z) or GNSS; a weighted constraint.

    Marks are targets or points under set-ups. The coordinates of a mark that was not measured must be known ten times
    more precisely than the vector.
    """

    name: SingleLine | None = None
    """Name of the vector, needed if several vectors join two marks; default: `A-B` for the marks A and B."""
    from_: str = Field(alias="from")
    """Survey mark at the start of the vector."""
    to: str
    """Survey mark at the end of the vector."""
    known_mm: Vector
    """Coordinates of `to` minus those of `from`."""
    known_sigma_mm: Sigma = 0.01
    """Standard deviation of each coordinate of the vector."""
    known_covariance_mm2: Covariance | None = None
    """Covariance xx, xy, xz, yy, yz, zz of the coordinates of the vector; it replaces `known_sigma_mm`."""
    known_axes: Axes = "xyz"
    """Axes along which the vector is known."""

    @property
    def label(self) -> str:
        """Name of the vector, or `A-B` from the names of its marks."""
        return self.name or f"{self.from_}-{self.to}"


class Reflector(TomlSection):
    """SMR with a radius, table `[reflectors.NAME]`; the column `reflector` or the target's key `reflector` names it."""

    radius_mm: Positive
    """Height of the SMR centre above the seat of its nest, or above the surface on which it lies; on a plane the radius
    of the SMR."""
    sigma_radius_mm: NonNegative | None = None
    """Standard deviation of the radius, an error that all pointings of the SMR share. Only `ltsim uncertainty` uses it;
    the adjustment treats the radius as exact."""


class BenchTest(TomlSection):
    """Range error of a reflector as a function of the angle of incidence, from a bench test: table `[[bench]]`.

    `ltsim bench` prints this table. It applies to reflectors that are not turned towards the station; the network
    adjustment estimates their range error as a function of incidence.
    """

    reflector: str = ""
    """Name of the SMR; without it the test applies to each SMR that has no test under its name."""
    angle_deg: tuple[Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)], ...]
    """Angles of incidence between beam and normal of the nest, negative on the side opposite to `direction_deg`."""
    error_um: tuple[Finite, ...]
    """Range error (reading minus true range) at each angle, up to an unknown constant."""
    sigma_um: tuple[NonNegative, ...]
    """Standard deviation of each range error, relative to the range error at normal incidence."""
    direction_deg: Finite = 0.0
    """Direction, around the normal of the nest, in which angles of incidence are positive: seen from the front of the
    nest, 0 is horizontal to the right and 90 is upwards. An index mark on the SMR shows it.
    """

    @model_validator(mode="after")
    def _check_equal_counts(self) -> BenchTest:
        counts = len(self.angle_deg), len(self.error_um), len(self.sigma_um)
        if len(set(counts)) > 1 or counts[0] < MIN_BENCH_ANGLES:
            angles, errors, sigmas = counts
            raise ValueError(
                f"the table has {angles} values of angle_deg, {errors} of error_um and {sigmas} of sigma_um, expected "
                f"equal numbers of at least {MIN_BENCH_ANGLES}"
            )
        return self


class Setup(TomlSection):
    """Content of `setup.toml`: prior knowledge about instruments, stations, targets and reference values."""

    format: Literal["ltsim-recording/1"] = "ltsim-recording/1"
    """Format and version of `setup.toml`."""
    title: str = ""
    """Title of the recording, free text."""
    started: str = ""
    """Start of the recording (time 0 of the pointings): date and time in ISO format, or only the time of day."""
    datum_source: SingleLine | None = None
    """Source of the coordinates of the datum targets, such as a file name. With it each datum target is tested against
    the others; one that contradicts them is removed from the datum and reported."""
    height_above_mark_sigma_mm: Sigma | None = None
    """Standard deviation of the height of a tracker head, or of a reflector, above its survey mark. With it the
    adjustment estimates a height correction in each occupation (columns `instrument_setup` and `target_setup`)."""
    curved: bool = False
    """True if the plumb lines of the stations differ, as on a sphere of the size of the earth. A station's key
    `vertical` has priority."""
    refraction: tuple[Finite, Sigma] | None = None
    """Coefficient of refraction near the ground (radius of the earth divided by that of the ray) and its standard
    deviation, such as [0.13, 0.1]. With this key the adjustment estimates the coefficient."""
    centring: tuple[CentringUncertainty, ...] = ()
    """Centring errors of the targets, one table `[[centring]]` each."""
    air: AirUncertainty | None = None
    """Uncertainty of the air along the beams, table `[air]`; its default values hold for halls."""
    report: ReportHeader | None = None
    """Header of a report: instrument, date, operator, customer."""
    instrument: Instrument = Instrument()
    """Instrument, table `[instrument]`, of a recording with one instrument."""
    instruments: dict[str, Instrument] = Field(default_factory=dict)
    """Instruments by name, tables `[instruments.NAME]`, of a recording with several instruments."""
    gauge: LengthGauge | None = None
    """Reference lengths with their temperatures, table `[gauge]`."""
    stations: dict[str, Station] = Field(default_factory=dict)
    """Prior knowledge about stations by name, tables `[stations.NAME]`."""
    targets: dict[str, Target] = Field(default_factory=dict)
    """Prior knowledge about targets by name, tables `[targets.NAME]`."""
    differences: tuple[ReferenceDifference, ...] = ()
    """Known vectors between survey marks, one table `[[differences]]` each."""
    reflectors: dict[str, Reflector] = Field(default_factory=dict)
    """SMRs with their radii, tables `[reflectors.NAME]`. The centre of an SMR is displaced along the nest normal by its
    radius minus the reference radius. Without these tables all SMRs have one radius."""
    bench: tuple[BenchTest, ...] = ()
    """Bench tests of reflectors, one table `[[bench]]` each."""
    reference_radius_mm: NonNegative | None = None
    """Radius of the SMR whose centre defines the coordinates of all targets; 0 for the seat of the nest. Default:
    common radius of the SMRs. The key must be above the first table of the file.
    """

    def instrument_of(self, station: str) -> Instrument:
        """Instrument at the station with this name."""
        return self.instrument_named(self.stations.get(station, Station()).instrument or "")

    def instrument_named(self, name: str) -> Instrument:
        """Instrument with this name; the table `[instrument]` if there is no such name."""
        return self.instruments.get(name, self.instrument)

    @property
    def measured_on(self) -> str | None:
        """Day, or day and time, of the measurement in ISO format; None if it is not given."""
        if self.report is not None and self.report.date is not None:
            return self.report.date
        try:
            return datetime.datetime.fromisoformat(self.started).isoformat()
        except ValueError:
            return None

    @property
    def instruments_text(self) -> str:
        """Model and serial number of each instrument, as text; with the name of the instrument if there are several."""
        tables = self.instruments or {"": self.instrument}
        words_by_name = {name: [word for word in (i.model, i.serial) if word] for name, i in tables.items()}
        return "; ".join(
            ", ".join([*([name] if len(tables) > 1 else []), *words]) for name, words in words_by_name.items() if words
        )
