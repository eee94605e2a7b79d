import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.effects.effect import Effect, LightPathStage, Parameter
from ltsim.scene.sightings import Sightings


def mean_reading_rates(sightings: Sightings) -> Floats:
    """Mean rates (n, 3) [m/s, rad/s] at which the readings changed since the previous pointing of the same station."""
    rate = np.zeros((len(sightings), 3))
    lapse = sightings.time - sightings.time[sightings.previous_pointing_indices]
    going = (sightings.previous_pointing_indices >= 0) & (lapse > 0)
    rate[going] = sightings.reading_changes_since_previous_pointing[going] / lapse[going, None]
    return rate


class TimingLag(Effect):
    """Timing lag: a reading is taken before the axis has settled, or a channel is delayed.

    The correction (true value minus reading) is Delta = rate of the reading times the lag, with a separate lag for
    range, azimuth and elevation. The rate is the change since the previous pointing of the station, divided by the time
    between both pointings. The rate is zero for the first pointing of a station.

    Size: 0.1 to 1 ms; a target moved at 0.1 m/s is off by 100 um in 1 ms.
    Similar to: backlash, if all motions take the same time.
    Separate by: dwell times of 0.1, 1 and 5 s.
    Validity: static targets at regular times. If the head turns faster than the mean rate used here, the estimated lag
    is too long by the ratio of both rates.
    Source: general knowledge; the equation describes a delayed channel.
    Validation: validated on a sequence of known rates; the size is general knowledge.
    """

    name = "timing-lag"
    base_rate = 0.5
    light_path_stage = LightPathStage.ELECTRONICS
    covariates = ("time", "approach")
    parameters = (
        Parameter("lag-distance", "ms", "delay of the range", 0.3e-3),
        Parameter("lag-azimuth", "ms", "delay of the azimuth", 0.3e-3),
        Parameter("lag-elevation", "ms", "delay of the elevation", 0.3e-3),
    )

    def design(self, sightings: Sightings) -> Floats:
        late = mean_reading_rates(sightings) * self.pointing_indicator(sightings)[:, None]
        return -late[:, :, None] * np.eye(3)
