from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Blunder, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class FaceConfusion(Blunder):
    """Confused faces: readings of one face are stored as readings of the other face.

    Pointings that are stored with the face `face` contain readings of the other face: the azimuth differs by 180 deg,
    and the elevation is 180 deg minus the expected value.

    Size: metres: a point lands behind the tracker.
    Similar to: nothing.
    Separate by: no measurement is needed, because the raw elevation shows the face.
    Validity: the parameter is 1 with the blunder and 0 without it. The blunder is corrected before an adjustment, so
    that `candidates` is empty and `possible_blunders` lists the possible blunders.
    Source: definition of the two faces of a theodolite; Deumlich and Staiger 2002, Instrumentenkunde der
    Vermessungstechnik.
    Validation: validated: the blunder applied twice restores the reading.
    """

    face: int = 2
    """Face, 1 or 2, in which the affected pointings are stored; they were measured in the other face."""

    name = "face-confusion"
    light_path_stage = LightPathStage.ELECTRONICS
    observables = ("azimuth", "elevation")
    covariates = ("face",)
    scope = "station"
    parameters = (Parameter("confused", "", "1 for exchanged faces", 1.0),)

    @classmethod
    def possible_blunders(cls, sightings: Sightings) -> list[Self]:
        """Exchanged faces that can occur: at each station, the pointings stored in face 1 or those stored in face 2."""
        return [cls((name,), face=face) for name in sightings.station_names for face in (1, 2)]

    def measured_sightings(self, sightings: Sightings) -> Sightings:
        """Sightings in which the affected pointings have the face in which they were measured."""
        confused = (self.pointing_indicator(sightings) > 0) & (sightings.face == self.face)
        return replace(sightings, face=np.where(confused, 3 - sightings.face, sightings.face))

    def design(self, sightings: Sightings) -> Floats:
        acts = self.pointing_indicator(sightings) * (sightings.face == self.face)
        azimuth, elevation = sightings.ideal_raw_readings[:, 1], sightings.ideal_raw_readings[:, 2]
        half_turn = np.where(azimuth > 0, -np.pi, np.pi)
        change = np.stack([np.zeros_like(azimuth), half_turn, np.pi - 2 * elevation], axis=1)
        confused: Floats = change * acts[:, None]
        return confused[:, :, None]
