from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.circles import CircleHarmonic, cos_sin_parameters
from ltsim.physics.effects.effect import LightPathStage


class ElevationHarmonic(CircleHarmonic):
    """Higher graduation harmonic of the elevation circle: errors of the scale as averaged by its read heads.

    Delta_elevation = A cos(m x) + B sin(m x), x the raw elevation, m from 3 up. In front-face values the cosine changes
    its sign with the face for even m, the sine for odd m.

    Size: 0.2 urad in a good circle, 2 urad in a bad one.
    Like: noise and errors of single targets; harmonics of the next orders, because a network covers only 110 deg.
    Separate by: two faces; more elevations.
    Valid: m up to 8.
    Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59,
    529-534.
    Status: validated against the exact chain in first order, face parity and sign.
    """

    name = "elevation-harmonic"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = cos_sin_parameters("elevation-harmonic", "`order` times the raw elevation", 2 * MICRORADIAN)
