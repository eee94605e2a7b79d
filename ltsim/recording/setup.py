"""What a person knows about a set-up: the contents of `setup.toml` (recording-format: ltsim-recording/1).

Keys carry their units as in the file; whoever needs SI converts at the door.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat

Vector = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Section(BaseModel):
    """A table of the file: unknown keys are refused, values cannot change."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)


class Noise(Section):
    """One standard deviation of white noise; sigma of a range = distance_mm + distance_ppm * range."""

    distance_mm: NonNegative = 0.003
    distance_ppm: NonNegative = 0.3
    azimuth_arcsec: PositiveFloat = 0.37
    elevation_arcsec: PositiveFloat = 0.37


class Prior(Section):
    """One standard deviation of what the maker guarantees."""

    range_scale_ppm: PositiveFloat = 2.0
    range_offset_mm: PositiveFloat = 0.010
    angle_arcsec: PositiveFloat = 3.0
    offset_mm: PositiveFloat = 0.020


class Limits(Section):
    """Travel of the elevation axis."""

    elevation_min_deg: FiniteFloat = -55.0
    elevation_max_deg: FiniteFloat = 77.0


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
    length_mm: PositiveFloat
    sigma_mm: PositiveFloat


class Gauge(Section):
    """Lengths known from elsewhere and the temperatures that bring them to the workshop."""

    calibrated_at_c: FiniteFloat = 20.0
    measured_at_c: FiniteFloat = 20.0
    expansion_per_k: FiniteFloat = 0.0
    distance: tuple[GaugeDistance, ...] = ()


class Station(Section):
    """What is known about one set-up, from the floor plan or a level."""

    position_mm: Vector | None = None
    yaw_deg: FiniteFloat | None = None
    levelled: bool = False
    levelling_sigma_arcsec: PositiveFloat = 1.0
    instrument: str | None = None
    instrument_height_mm: FiniteFloat = 0.0


class Target(Section):
    """What is known about one reflector position."""

    nest_normal: Vector | None = None
    reflector: str | None = None
    reaimed: bool = True
    known_mm: Vector | None = None
    known_sigma_mm: PositiveFloat = 0.01
    height_mm: FiniteFloat = 0.0


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
        return self.instruments[name] if name in self.instruments else self.instrument
