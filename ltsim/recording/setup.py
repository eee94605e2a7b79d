"""What a person knows about a set-up: the contents of `setup.toml` (recording-format: ltsim-recording/1).

Keys carry their units as in the file; whoever needs SI converts at the door.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Finite = Annotated[float, Field(ge=-1e11, le=1e11, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e9, allow_inf_nan=False)]
Axes = Literal["xyz", "xy", "xz", "yz", "x", "y", "z"]
Vector = tuple[Finite, Finite, Finite]


class Section(BaseModel):
    """A table of the file: unknown keys are refused, values cannot change."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Noise(Section):
    """One standard deviation of white noise; sigma of a range = distance_mm + distance_ppm * range."""

    distance_mm: NonNegative = 0.003
    distance_ppm: NonNegative = 0.3
    azimuth_arcsec: Positive = 0.37
    elevation_arcsec: Positive = 0.37

    @model_validator(mode="after")
    def _some_range_noise(self) -> Noise:
        if self.distance_mm == 0 and self.distance_ppm == 0:
            raise ValueError("it should not be 0 in both distance_mm and distance_ppm")
        return self


class Prior(Section):
    """One standard deviation of what the maker guarantees."""

    range_scale_ppm: Positive = 2.0
    range_offset_mm: Positive = 0.010
    angle_arcsec: Positive = 3.0
    offset_mm: Positive = 0.020


class Limits(Section):
    """Travel of the elevation axis."""

    elevation_min_deg: Finite = -55.0
    elevation_max_deg: Finite = 77.0


class Instrument(Section):
    """One instrument: construction, noise, what its maker guarantees, its limits."""

    construction: Literal["source-in-head", "steering-mirror"] = "source-in-head"
    corrected: bool = False
    noise: Noise = Noise()
    prior: Prior = Prior()
    limits: Limits | None = None


class GaugeDistance(Section):
    """A known length between two targets, at `calibrated_at_c`."""

    from_: str = Field(alias="from")
    to: str
    length_mm: Positive
    sigma_mm: Positive


class Gauge(Section):
    """Lengths known from elsewhere and the temperatures that bring them to the workshop."""

    calibrated_at_c: Finite = 20.0
    measured_at_c: Finite = 20.0
    expansion_per_k: Finite = 0.0
    distance: tuple[GaugeDistance, ...] = ()


class Station(Section):
    """What is known about one set-up, from the floor plan or a level.

    `over` names the target whose mark the instrument stands on, `instrument_height_mm` above it along
    `vertical`: the direction of plumb there in the network frame (z where it is not given; it differs where a
    network is wide enough to feel the curvature of the earth).
    """

    position_mm: Vector | None = None
    yaw_deg: Finite | None = None
    levelled: bool = False
    levelling_sigma_arcsec: Positive = 1.0
    instrument: str | None = None
    instrument_height_mm: Finite = 0.0
    over: str | None = None
    vertical: Vector | None = None


class Target(Section):
    """What is known about one reflector position.

    `known_mm` holds with `known_sigma_mm` along `known_axes`. `approximate_mm` is a start value without
    weight; where `datum` is set, all such targets together define the frame by inner constraints.
    """

    nest_normal: Vector | None = None
    reflector: str | None = None
    reaimed: bool = True
    known_mm: Vector | None = None
    known_sigma_mm: Positive = 0.01
    known_axes: Axes = "xyz"
    approximate_mm: Vector | None = None
    datum: bool = False
    height_mm: Finite = 0.0


class Setup(Section):
    """The whole file."""

    format: Literal["ltsim-recording/1"] = "ltsim-recording/1"
    title: str = ""
    instrument: Instrument = Instrument()
    instruments: dict[str, Instrument] = Field(default_factory=dict)
    gauge: Gauge | None = None
    stations: dict[str, Station] = Field(default_factory=dict)
    targets: dict[str, Target] = Field(default_factory=dict)

    def instrument_of(self, station: str) -> Instrument:
        """Give the instrument that stood at `station`."""
        name = self.stations.get(station, Station()).instrument
        return self.instruments.get(name or "", self.instrument)
