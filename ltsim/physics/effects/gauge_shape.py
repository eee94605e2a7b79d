from dataclasses import dataclass
from typing import Self

import numpy as np

from ltsim.core.arrays import Floats, Ints
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, axis_parameters
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class GaugeShape(Effect):
    """Shape of the gauge: a nest moved, or the gauge bent, after its lengths were measured.

    A gauge is a set of reflectors at known distances. If one nest moved by D after the lengths were determined, then
    true length = declared length + D . u, with the unit vector u from the other end of the length towards the nest. The
    parameters are the motion of the nest in the network frame (no correction of a reading). No reading changes, because
    the readings refer to the present position.

    Size: a difference of 1 K across a frame 20 mm thick with nests 40 mm above it changes 590 mm by 28 um; a nest moves
    by 5 to 50 um.
    Similar to: smr-centring or dirt in the gauge's nest.
    Separate by: a new determination of the gauge's lengths; exchanged reflectors.
    Validity: motions that are small compared with the lengths; a bend out of the plane of a flat gauge does not change
    its lengths.
    Source: Sensors 2021, 21, 7479, doi:10.3390/s21227479, table 2 and section 2.3 (the gauge; 2.3 + L/300 um of the
    machine that measured it).
    Validation: validated against moved points on the known lengths.
    """

    target_index: int = 0
    """Index, among the targets of the network, of the target whose nest moved."""

    name = "gauge-shape"
    light_path_stage = LightPathStage.TARGET
    observables = ()
    covariates = ("place",)
    scope = "target"
    may_recur = True
    parameters = axis_parameters("nest", "um", "motion of the nest along", 30 * MICROMETRE)

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Moved nests that a diagnosis tries, one per target; nests that change no known length are dropped later."""
        return [cls((), (name,), i) for i, name in enumerate(sightings.target_names)]

    def design(self, sightings: Sightings) -> Floats:
        return np.zeros((len(sightings), 3, 3))

    def gauge_design(self, first_targets: Ints, second_targets: Ints, points: Floats) -> Floats:
        gap = points[first_targets] - points[second_targets]
        unit = gap / np.linalg.norm(gap, axis=1, keepdims=True)
        ends = (second_targets == self.target_index).astype(float) - (first_targets == self.target_index)
        return unit * ends[:, None]
