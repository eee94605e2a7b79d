from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE, MICRORADIAN
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings

Observable = Literal["distance", "azimuth", "elevation"]
"""Name of an observable (kind of reading)."""


READING_COLUMN_BY_OBSERVABLE: dict[Observable, int] = {"distance": 0, "azimuth": 1, "elevation": 2}
"""Column of each observable in an array of readings: distance 0, azimuth 1, elevation 2."""
MAX_POINTINGS_WITH_CANDIDATE_OUTLIERS = 1500
"""Number of pointings above which a diagnosis tries no outliers, because the w-test of an adjustment detects them."""


@dataclass(frozen=True)
class Outlier(Effect):
    """Outlier: one reading of one pointing is wrong.

    The parameter is the correction of this reading, whatever the cause of its error.

    Size: any; an error of a range is detected from 16 um on.
    Similar to: nest-lift (correlation 0.85), which changes all three readings of a pointing.
    Separate by: a repeat of the pointing.
    Validity: any size below a millimetre; larger outliers are rejected before an adjustment. In large recordings
    `candidates` is empty, because the w-test of the residuals detects single readings.
    Source: Baarda 1968, A testing procedure for use in geodetic networks (data snooping).
    Validation: validated on a single pointing.
    """

    row: int = 0
    """Index of the pointing in the recording, from 0."""
    observable: Observable = "distance"
    """Observable (kind of reading) that is wrong."""

    name = "outlier"
    base_rate = 8.0
    light_path_stage = LightPathStage.ELECTRONICS
    scope = "reading"
    may_recur = True
    parameters = (Parameter("outlier", "um", "correction of the range", 300 * MICROMETRE),)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observables", (self.observable,))
        if self.observable != "distance":
            angle = Parameter("outlier", "urad", f"correction of the raw {self.observable}", 100 * MICRORADIAN)
            object.__setattr__(self, "parameters", (angle,))

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Outliers that a diagnosis tries: one per reading, or none in a large recording."""
        if len(sightings) > MAX_POINTINGS_WITH_CANDIDATE_OUTLIERS:
            return []
        places = [
            ((sightings.station_names[s],), (sightings.target_names[t],))
            for s, t in zip(sightings.station, sightings.target, strict=True)
        ]
        return [cls(*place, row, o) for o in READING_COLUMN_BY_OBSERVABLE for row, place in enumerate(places)]

    def design(self, sightings: Sightings) -> Floats:
        design = np.zeros((len(sightings), 3, 1))
        if self.row < len(sightings):
            design[self.row, READING_COLUMN_BY_OBSERVABLE[self.observable], 0] = -self.pointing_indicator(sightings)[
                self.row
            ]
        return design
