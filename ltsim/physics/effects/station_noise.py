from ltsim.physics.effects.noise_level import NoiseLevel


class StationNoise(NoiseLevel):
    """Noise of one station: an unstable stand, a fan or sunshine increases the scatter of its readings.

    variance = sigma^2 (1 + v) at that station, with v the added variance divided by the declared one.

    Size: v of 0.5 to 10.
    Similar to: noise-level (all stations), a target or station that moves often.
    Separate by: repeats at that station.
    Validity: noise that is independent from pointing to pointing.
    Source: Teunissen 2000, Testing Theory: an introduction (weights come before tests).
    Validation: validated: with v = 0 the variance is the declared one; the variance at other stations does not change.
    """

    name = "station-noise"
    base_rate = 1.0
    min_relative_size = 0.0
    covariates = ("place",)
    scope = "station"
