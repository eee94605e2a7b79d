from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import unknown_name
from ltsim.physics.effects.effect import Mistake, Parameter, Stage
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.transcription_errors import UNIT_ERRORS, TranscriptionError
from ltsim.scene.sightings import Sightings

SLIPS = {slip.name: slip for slip in UNIT_ERRORS}


@dataclass(frozen=True)
class WrongUnit(Mistake):
    """Wrong unit: the readings of a station are in other units, count another way, or hold zeniths for elevations.

    The reading becomes the reading times a factor, or its complement to a right angle, or counts clockwise; the slips
    are those of `recording.slips`.

    Size: metres.
    Like: nothing; the pose fit misses by metres.
    Separate by: nothing is needed.
    Valid: the parameter is 1 where it happened and 0 elsewhere. A mistake of this size is mended before an adjustment,
    so `candidates` is empty and `possible` lists the mistakes. Weather in a wrong unit is station-weather.
    Source: definitions of the units; BIPM, The International System of Units (SI Brochure).
    Status: validated on the readings: what the mend gives back is what was read.
    """

    mistake: str = "gon"

    name = "wrong-unit"
    stage = Stage.ELECTRONICS
    scope = "station"
    parameters = (Parameter("mistaken", "", "1 for a wrong unit", 1.0),)

    def __post_init__(self) -> None:
        if self.mistake not in SLIPS:
            raise unknown_name("slip", self.mistake, SLIPS)
        object.__setattr__(self, "observables", tuple(OBSERVABLES[c] for c in self.slip.columns))

    @property
    def slip(self) -> TranscriptionError:
        """Transcription error of this blunder: the unit or convention that was written, and the expected one."""
        return SLIPS[self.mistake]

    @classmethod
    def at(cls, station: str) -> list[Self]:
        """Blunders of every unit and convention at one station."""
        return [cls((station,), mistake=name) for name in SLIPS]

    @classmethod
    def possible(cls, sightings: Sightings) -> list[Self]:
        """Possible blunders: every unit and convention at every station."""
        return [effect for name in sightings.station_names for effect in cls.at(name)]

    def written(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) in the wrong unit."""
        return np.where(self.mask(sightings)[:, None] > 0, self.slip.written(readings), readings)

    def design(self, sightings: Sightings) -> Floats:
        return (self.written(sightings, sightings.raw) - sightings.raw)[:, :, None]
