"""Prior knowledge about a set-up: the contents of `setup.toml` (recording-format: ltsim-recording/1).

Keys carry their units as in the file; code that needs SI converts them.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Literal

from pydantic import Field, model_validator

from ltsim.recordings.air import Air
from ltsim.recordings.keys import (
    EXACT_LEVEL_ARCSEC as EXACT_LEVEL_ARCSEC,
    LEAST_SIGMA as LEAST_SIGMA,
    Axes as Axes,
    Covariance as Covariance,
    Date as Date,
    Direction as Direction,
    Elevation as Elevation,
    Finite as Finite,
    Height as Height,
    Line as Line,
    NonNegative as NonNegative,
    Positive as Positive,
    Sigma as Sigma,
    TomlSection as TomlSection,
    Vector as Vector,
    symmetric as symmetric,
)  # fmt: skip

FEWEST_ANGLES = 3
"""Angles of a bench test: normal incidence and one on each side."""


class Noise(TomlSection):
    """Standard deviation of white noise; sigma of a range = distance_mm + distance_ppm * range."""

    distance_mm: NonNegative = 0.003
    """The part of a range's sigma that does not grow with the range."""
    distance_ppm: NonNegative = 0.3
    """The part that grows with it: sigma = distance_mm + distance_ppm * range."""
    azimuth_arcsec: Sigma = 0.37
    """Standard deviation across the beam; that of an azimuth reading is this over the cosine of the elevation."""
    elevation_arcsec: Sigma = 0.37
    """Standard deviation of elevation readings."""

    @model_validator(mode="after")
    def _positive_range_noise(self) -> Noise:
        if max(self.distance_mm, self.distance_ppm) < LEAST_SIGMA:
            raise ValueError("it should not be 0 in both distance_mm and distance_ppm")
        return self


class Prior(TomlSection):
    """Prior standard deviations (one sigma) of the instrument's parameters, as the maker guarantees them."""

    range_scale_ppm: Sigma = 2.0
    """Standard deviation of the scale of the ranges: laser frequency and air."""
    range_offset_mm: Sigma = 0.010
    """Standard deviation of the zero of the ranges."""
    angle_arcsec: Sigma = 3.0
    """Standard deviation of every angular misalignment and every encoder term."""
    offset_mm: Sigma = 0.020
    """Standard deviation of every offset of an axis or the beam."""
    parameters: dict[str, Positive] = Field(default_factory=dict)
    """Standard deviations of single parameters by name, each in the parameter's unit, in place of the kinds above."""


class Limits(TomlSection):
    """Travel of the elevation axis."""

    elevation_min_deg: Elevation = -55.0
    """Lowest elevation that can be pointed at."""
    elevation_max_deg: Elevation = 77.0
    """Highest one."""

    @model_validator(mode="after")
    def _upward(self) -> Limits:
        if self.elevation_min_deg >= self.elevation_max_deg:
            raise ValueError("it should have elevation_min_deg below elevation_max_deg")
        return self


class Instrument(TomlSection):
    """Instrument: construction, noise, maker's guarantee, limits."""

    construction: Literal["source-in-head", "steering-mirror"] = "source-in-head"
    """Origin of the beam: a source in the turning head, or a mirror that steers it."""
    model: Line | None = None
    """Maker and model, such as "Leica AT960", for the head of a report."""
    serial: Line | None = None
    """Serial number, for the head of a report."""
    sheet: Line | None = None
    """A built-in data sheet: noise and prior below what the file states of them, and the model."""
    corrected: bool = False
    """The maker's or a former calibration's corrections are already in the readings."""
    noise: Noise = Noise()
    """Standard deviations of its white noise."""
    prior: Prior = Prior()
    """Prior standard deviations of its parameters, from the maker's guarantees."""
    limits: Limits | None = None
    """Travel limits of its elevation axis."""


class Material(TomlSection):
    """Material of a gauge or a scale bar; lengths of one material share the error of its coefficient."""

    expansion_per_k: Finite = 0.0
    """Coefficient of thermal expansion."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the coefficient; none where it is not given."""


class LengthUse(TomlSection):
    """Material of a known length, and its temperature when it was used."""

    measured_at_c: Finite | Line | None = None
    """Temperature of this length: a number, or a column of the recording, whose mean over the pointings at both ends
    counts; the gauge's where it is not given."""
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of that temperature, shared by all lengths of the same column; the gauge's where it is not
    given."""
    material: Line | None = None
    """Name of a table of materials; the gauge's own coefficient holds where it is not given."""
    measured_in_place: bool = False
    """Measured between its ends where they stand, as by an interferometer: it does not grow."""


class GaugeDistance(LengthUse):
    """A known length between two targets, at `calibrated_at_c`."""

    from_: str = Field(alias="from")
    """Target at one end."""
    to: str
    """Target at the other end."""
    length_mm: Positive
    """Length at `calibrated_at_c`, or as it was measured in place."""
    sigma_mm: Sigma
    """Standard deviation of the length."""


class Gauge(TomlSection):
    """Lengths known from elsewhere and the temperatures that bring them to the workshop."""

    calibrated_at_c: Finite = 20.0
    """Temperature to which the lengths refer."""
    measured_at_c: Finite | Line = 20.0
    """Temperature of the gauge during the recording, or the column that holds it."""
    expansion_per_k: Finite = 0.0
    """Coefficient of thermal expansion."""
    sigma_expansion_per_k: NonNegative | None = None
    """Standard deviation of the coefficient, shared by all lengths; none where it is not given."""
    sigma_temperature_k: NonNegative | None = None
    """Standard deviation of that temperature; none where it is not given."""
    sigma_scale_ppm: NonNegative | None = None
    """Standard deviation of a scale that all lengths share, whatever it comes from; from 1000 on nothing is known."""
    materials: dict[str, Material] | None = None
    """Other materials by name, tables `[gauge.materials.NAME]`."""
    distance: tuple[GaugeDistance, ...] = ()
    """Reference lengths, a table `[[gauge.distance]]` each."""


class Station(TomlSection):
    """Prior knowledge about one set-up, from the floor plan or a level.

    `over` names the target whose mark the instrument stands on, `instrument_height_mm` above it along
    `vertical`: the direction of plumb there in the network frame (z where it is not given; it differs where a
    network is wide enough to feel the curvature of the earth).
    """

    position_mm: Vector | None = None
    """Rough place of the head on the floor plan, without weight: it turns nest directions into the frame."""
    yaw_deg: Finite | None = None
    """Direction of azimuth zero, counter-clockwise from x: a rough one, used where no three places are known."""
    yaw_sigma_arcsec: Sigma | None = None
    """Standard deviation of `yaw_deg`, as by a gyroscope: it is then a condition with weight at a levelled station."""
    levelled: bool = False
    """Levelled standing axis: a condition with weight."""
    levelling_sigma_arcsec: Sigma = 1.0
    """Standard deviation of the level."""
    instrument: str | None = None
    """Name of the instrument that stood here, a table `[instruments.NAME]`."""
    instrument_height_mm: Height = 0.0
    """Height of the head above its mark."""
    over: str | None = None
    """Target whose mark the instrument stands over."""
    vertical: Direction | None = None
    """Direction of plumb here, in the network's frame; z where it is not given."""

    @model_validator(mode="after")
    def _oriented(self) -> Station:
        if self.yaw_sigma_arcsec is not None and (self.yaw_deg is None or not self.levelled):
            raise ValueError("it should have yaw_deg, and levelled = true, where it states yaw_sigma_arcsec")
        return self


class Target(TomlSection):
    """Prior knowledge about one reflector position.

    `known_mm` holds with `known_sigma_mm`, or `known_covariance_mm2`, along `known_axes`. `approximate_mm` is a start
    value without weight; where `datum` is set, all such targets together define the frame by inner constraints, each
    along its `datum_axes` (three targets with "xyz", "yz" and "z" span axes by the 3-2-1 rule).
    """

    nest_normal: Direction | None = None
    """Direction of the open face of a fixed reflector, on the floor plan."""
    reflector: str | None = None
    """Name of the SMR, where a pointing names no other; targets that share one share its errors."""
    reaimed: bool = True
    """Turned toward the station before each pointing."""
    known_mm: Vector | None = None
    """Coordinates of a control point: a condition with weight."""
    known_sigma_mm: Sigma = 0.01
    """Standard deviation of each known coordinate."""
    known_covariance_mm2: Covariance | None = None
    """Covariance xx, xy, xz, yy, yz, zz of the known coordinates, in place of `known_sigma_mm`."""
    known_axes: Axes = "xyz"
    """Axes along which the coordinates are known."""
    in_plan: bool = False
    """Adjusted in plan only: whatever stands for its height means nothing, and none is written."""
    approximate_mm: Vector | None = None
    """A start value without weight."""
    datum: bool = False
    """Takes part in the inner constraints that define the frame."""
    datum_axes: Axes = "xyz"
    """Along which axes it does."""
    height_mm: Height = 0.0
    """Height of the reflector above the mark that the name stands for."""


class ReferenceDifference(TomlSection):
    """Known vector from one mark to another, as by levelling (along z) or by satellites: a weighted constraint.

    Marks are targets, or those under set-ups; an unmeasured one has to be known ten times better than the difference.
    """

    name: Line | None = None
    """Name, where several differences join the same marks; the marks' names where it is not given, as `A-B`."""
    from_: str = Field(alias="from")
    """Mark at one end."""
    to: str
    """Mark at the other end."""
    known_mm: Vector
    """Coordinates of `to` less those of `from`."""
    known_sigma_mm: Sigma = 0.01
    """Standard deviation of each known coordinate."""
    known_covariance_mm2: Covariance | None = None
    """Covariance xx, xy, xz, yy, yz, zz of the known coordinates, in place of `known_sigma_mm`."""
    known_axes: Axes = "xyz"
    """Axes along which the coordinates are known."""

    @property
    def called(self) -> str:
        """Name of the difference."""
        return self.name or f"{self.from_}-{self.to}"


class Reflector(TomlSection):
    """SMR, table `[reflectors.NAME]`: pointings name it in the column `reflector`, or its target does."""

    radius_mm: Positive
    """Height of its centre over the surface or the seat of the nest that it stands in: its radius on a plane."""
    sigma_radius_mm: NonNegative | None = None
    """Standard deviation of the radius, an error that all its pointings share: a source of `ltsim uncertainty`;
    the adjustment takes the radius for exact."""


class BenchTest(TomlSection):
    """Range error of a reflector against incidence from its bench test, a table `[[bench]]` that `ltsim bench` prints.

    It holds for fixed nests, where the incidence error is estimated with the network.
    """

    reflector: str = ""
    """Name of the SMR; without one it is that of every SMR that has no test."""
    angle_deg: tuple[Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)], ...]
    """Angles of incidence."""
    error_um: tuple[Finite, ...]
    """Range error at each angle, reading minus truth, from any zero."""
    sigma_um: tuple[NonNegative, ...]
    """Standard deviation of each error less that at normal incidence."""
    direction_deg: Finite = 0.0
    """Direction of the positive angles around the nest, 0 along the horizontal, as the mark of the SMR was oriented."""

    @model_validator(mode="after")
    def _whole(self) -> BenchTest:
        counts = len(self.angle_deg), len(self.error_um), len(self.sigma_um)
        if len(set(counts)) > 1 or counts[0] < FEWEST_ANGLES:
            angles, errors, sigmas = counts
            raise ValueError(
                f"it has {angles} angles, {errors} errors and {sigmas} sigmas, expected as many of each, "
                f"{FEWEST_ANGLES} or more"
            )
        return self


class About(TomlSection):
    """Head of a report, table `[report]`; nothing is computed from it."""

    instrument: Line | None = None
    """Maker, model and serial number, such as "Leica AT960, 751234"; default those of the instruments."""
    date: Date | None = None
    """Day of the measurement, year-month-day."""
    operator: Line | None = None
    """Name of the operator."""
    customer: Line | None = None
    """Name of the customer."""


class Setup(TomlSection):
    """The whole file."""

    format: Literal["ltsim-recording/1"] = "ltsim-recording/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    started: str = ""
    """Start of the recording (time 0): date and clock in ISO form, or the clock alone."""
    axes: Line | None = None
    """Source of the coordinates of the datum's targets: each target is checked against the others, and one that they
    contradict is left out of the datum and reported."""
    heads_sigma_mm: Sigma | None = None
    """Standard deviation of the height of a head over its mark; where it is given, the network corrects the height of
    each occupation, which the columns `instrument_setup` and `target_setup` name."""
    curved: bool = False
    """Plumb lines differ by place, as on a sphere like the earth, where a station does not state its `vertical`."""
    refraction: tuple[Finite, Sigma] | None = None
    """Coefficient of refraction near the ground (radius of the earth over that of the ray) and its standard deviation,
    such as [0.13, 0.1]; where it is given, the network estimates the coefficient."""
    air: Air | None = None
    """Uncertainty of the air along the beams, a table `[air]`; the default sizes of its keys hold in halls."""
    report: About | None = None
    """Head of a report: instrument, date, operator, customer."""
    instrument: Instrument = Instrument()
    """The instrument, where one made the whole recording."""
    instruments: dict[str, Instrument] = Field(default_factory=dict)
    """Several instruments by name, tables `[instruments.NAME]`."""
    gauge: Gauge | None = None
    """Lengths known from elsewhere."""
    stations: dict[str, Station] = Field(default_factory=dict)
    """Prior knowledge about set-ups, tables `[stations.NAME]`."""
    targets: dict[str, Target] = Field(default_factory=dict)
    """Prior knowledge about reflector positions, tables `[targets.NAME]`."""
    differences: tuple[ReferenceDifference, ...] = ()
    """Known differences of marks, a table `[[differences]]` each."""
    reflectors: dict[str, Reflector] = Field(default_factory=dict)
    """SMRs with radii of their own, tables `[reflectors.NAME]`; the difference to the reference lies along the nest's
    normal. Without any, all SMRs are taken for one."""
    bench: tuple[BenchTest, ...] = ()
    """Bench tests of reflectors, a table `[[bench]]` each."""
    reference_radius_mm: NonNegative | None = None
    """A target is the centre of an SMR of this radius in its nest, 0 for the seat itself, whatever SMR was in it; the
    radius of the SMRs in use where they have one. It stands above the first table."""

    def instrument_of(self, station: str) -> Instrument:
        """Instrument that stood at `station`."""
        return self.instrument_named(self.stations.get(station, Station()).instrument or "")

    def instrument_named(self, name: str) -> Instrument:
        """Instrument of this name; the only one where no table has it."""
        return self.instruments.get(name, self.instrument)

    @property
    def measured(self) -> str | None:
        """Day, or day and time, of the measurement in ISO form; None where it is not given."""
        if self.report is not None and self.report.date is not None:
            return self.report.date
        try:
            return datetime.datetime.fromisoformat(self.started).isoformat()
        except ValueError:
            return None

    @property
    def instruments_in_words(self) -> str:
        """Model and serial number of each instrument that states them, with its name where there are several."""
        tables = self.instruments or {"": self.instrument}
        words_of = {name: [word for word in (i.model, i.serial) if word] for name, i in tables.items()}
        return "; ".join(
            ", ".join([*([name] if len(tables) > 1 else []), *words]) for name, words in words_of.items() if words
        )
