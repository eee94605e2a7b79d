from dataclasses import replace
from itertools import combinations
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Blunder, LightPathStage, Parameter
from ltsim.physics.effects.motions import reading_change_by_displacement
from ltsim.scene.sightings import Sightings


class TargetSwap(Blunder):
    """Swapped targets: at one station two reflectors have each other's name.

    Each target has the reading of the other target. The change of a reading is therefore the reading of the other
    target minus the reading of the target itself.

    Size: the distance between the two targets.
    Similar to: two outliers, equal and opposite.
    Separate by: no measurement is needed, because the residual equals the distance between the targets.
    Validity: the parameter is 1 with the blunder and 0 without it. The blunder is corrected before an adjustment, so
    that `candidates` is empty and `possible_blunders` lists the pairs.
    Source: general knowledge of networks.
    Validation: validated against a recording with two names exchanged.
    """

    name = "target-swap"
    light_path_stage = LightPathStage.ELECTRONICS
    covariates = ("place",)
    scope = "pointing"
    parameters = (Parameter("swapped", "", "1 for exchanged targets", 1.0),)

    @classmethod
    def possible_blunders(cls, sightings: Sightings) -> list[Self]:
        """Exchanged names that can occur: each pair of targets at each station."""
        name_pairs = list(combinations(sightings.target_names, 2))
        return [cls((station,), pair) for station in sightings.station_names for pair in name_pairs]

    def measured_sightings(self, sightings: Sightings) -> Sightings:
        """Sightings with the two targets as they were measured; the recording exchanges their names."""
        if len(self.targets) != 2:
            return sightings
        a, b = (sightings.target_names.index(name) for name in self.targets)
        exchanged_target = np.where(sightings.target == a, b, a)
        return replace(
            sightings, target=np.where(self.pointing_indicator(sightings) > 0, exchanged_target, sightings.target)
        )

    def design(self, sightings: Sightings) -> Floats:
        if len(self.targets) != 2:
            return np.zeros((len(sightings), 3, 1))
        a, b = (sightings.target_names.index(name) for name in self.targets)
        partner = np.where(sightings.target == a, b, a)
        gap = sightings.target_points[partner] - sightings.target_points[sightings.target]
        acts = self.pointing_indicator(sightings)[:, None]
        return reading_change_by_displacement(sightings, gap * acts)[:, :, None]
