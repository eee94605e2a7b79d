from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.errors import ModelError, unknown_name_error
from ltsim.physics.effects.effect import Blunder, LightPathStage, Parameter
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.transcription_errors import UNIT_AND_CONVENTION_ERRORS, WrongColumnConversion
from ltsim.scene.sightings import Sightings

UNIT_ERRORS_BY_NAME = {slip.name: slip for slip in UNIT_AND_CONVENTION_ERRORS}
"""Transcription errors of units and conventions (such as gon for degrees) by name."""


@dataclass(frozen=True)
class WrongUnit(Blunder):
    """Wrong unit: readings of a station or of one face are in another unit, in the opposite sense, or zenith angles.

    The correct reading is multiplied by a factor, replaced by its complement to a right angle, or counted clockwise.
    `recordings.transcription_errors` lists these errors.

    Size: metres.
    Similar to: nothing; residuals of the station's resection are metres.
    Separate by: no measurement is needed.
    Validity: the parameter is 1 with the blunder and 0 without it. The blunder is corrected before an adjustment, so
    that `candidates` is empty and `possible_blunders` lists the possible blunders. Weather values in a wrong unit are
    the effect station-weather.
    Source: definitions of the units; BIPM, The International System of Units (SI Brochure).
    Validation: validated on the readings: the correction restores the original reading.
    """

    mistake: str = "gon"
    """Name of the wrong unit or convention, a key of `UNIT_ERRORS_BY_NAME`."""
    face: int = 0
    """Face, 1 or 2, whose readings are in the wrong unit; 0 for both faces."""

    name = "wrong-unit"
    light_path_stage = LightPathStage.ELECTRONICS
    scope = "station"
    parameters = (Parameter("mistaken", "", "1 for a wrong unit", 1.0),)

    def __post_init__(self) -> None:
        if self.mistake not in UNIT_ERRORS_BY_NAME:
            raise unknown_name_error("wrong unit", self.mistake, UNIT_ERRORS_BY_NAME)
        if self.face not in (0, 1, 2):
            raise ModelError(f"face = {self.face}: expected 1 or 2, or 0 for both faces")
        object.__setattr__(self, "observables", tuple(OBSERVABLES[c] for c in self.transcription_error.changed_columns))

    @property
    def transcription_error(self) -> WrongColumnConversion:
        """Transcription error of this blunder, with the unit or convention that was written and the correct one."""
        return UNIT_ERRORS_BY_NAME[self.mistake]

    @classmethod
    def blunders_at_station(cls, station: str) -> list[Self]:
        """Wrong units and conventions that can occur at one station."""
        return [cls((station,), mistake=name) for name in UNIT_ERRORS_BY_NAME]

    @classmethod
    def possible_blunders(cls, sightings: Sightings) -> list[Self]:
        """Wrong units and conventions that can occur at the stations of a network, one per unit and station."""
        return [effect for name in sightings.station_names for effect in cls.blunders_at_station(name)]

    def recorded_readings(self, sightings: Sightings, readings: Floats) -> Floats:
        """Readings (n, 3) of n pointings in the wrong unit, from the correct readings (n, 3)."""
        is_in_face = np.full(len(readings), True) if self.face == 0 else sightings.face == self.face
        is_changed = (self.pointing_indicator(sightings) > 0) & is_in_face
        return np.where(is_changed[:, None], self.transcription_error.with_error(readings), readings)

    def design(self, sightings: Sightings) -> Floats:
        return (self.recorded_readings(sightings, sightings.ideal_raw_readings) - sightings.ideal_raw_readings)[
            :, :, None
        ]
