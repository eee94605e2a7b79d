from dataclasses import dataclass
from typing import Self

from ltsim.core.arrays import Floats
from ltsim.core.units import MICROMETRE
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter, design_from_front_face_corrections
from ltsim.physics.effects.places import candidate_station_change_times, neighbouring_gap_times
from ltsim.scene.sightings import Sightings


@dataclass(frozen=True)
class RangeStep(Effect):
    """Step of the range zero: the beam is interrupted, and the zero has another value afterwards.

    The correction (true value minus reading) of a range is Delta_d = rho, the size of the step, from the time of the
    step to the last pointing of the station.

    Size: 5 um in a current tracker, 20 to 50 um in a bad one.
    Similar to: reflector-constant (exactly) and station-weather (correlation 0.965), if the step is at the start of the
    station; station-bump.
    Separate by: near and far targets at that station; a target measured before and after the step.
    Validity: one step per station; the step does not act at the next station.
    Source: general knowledge: an interferometer is homed again after each lost beam, an absolute distance meter keeps
    its zero.
    Validation: validated on pointings before and after the step.
    """

    time: float = 0.0
    """Time [s] of the step of the range zero."""

    name = "range-step"
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    covariates = ("time",)
    scope = "station"
    parameters = (
        Parameter("range-step", "um", "length by which every range after the step is too short", 30 * MICROMETRE),
    )

    @classmethod
    def candidates(cls, sightings: Sightings) -> list[Self]:
        """Steps that a diagnosis tries: at the first pointing of each station, and between any two of its pointings."""
        starts = [
            (name, float(sightings.time[sightings.station == s].min(initial=0.0)))
            for s, name in enumerate(sightings.station_names)
        ]
        candidate_change_times = candidate_station_change_times(sightings, min_pointings=2)
        return [cls((name,), time=time) for name, time in [*starts, *candidate_change_times]]

    def neighbours(self, sightings: Sightings) -> list[Self]:
        """Copies of this step in neighbouring gaps between pointings, which a local search tries."""
        return [self.with_shape_parameters(time=t) for t in neighbouring_gap_times(self, sightings, self.time)]

    def design(self, sightings: Sightings) -> Floats:
        after = self.pointing_indicator(sightings) * (sightings.time >= self.time)
        return design_from_front_face_corrections(sightings, distance=after)[:, :, None]
