from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.circles import CircleHarmonic, cos_sin_parameters
from ltsim.physics.effects.effect import LightPathStage


class ElevationHarmonic(CircleHarmonic):
    """Higher graduation harmonic of the elevation circle: the lines of its scale are not evenly spaced.

    The correction (true value minus reading) is Delta_elevation = A cos(m x) + B sin(m x), with the raw elevation x,
    the order m from 3 up, and the parameters A and B. Reduced to face 1, the cosine term changes its sign with the face
    for even m, the sine term for odd m.

    Size: 0.2 urad in a good circle, 2 urad in a bad one.
    Similar to: noise and errors of single targets; harmonics of the next orders, because the elevations of a network
    cover only 110 deg.
    Separate by: two faces; more elevations.
    Validity: m up to 8.
    Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59,
    529-534.
    Validation: validated against the exact kinematic chain in first order, face parity and sign.
    """

    name = "elevation-harmonic"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("elevation",)
    covariates = ("elevation",)
    parameters = cos_sin_parameters("elevation-harmonic", "`order` times the raw elevation", 2 * MICRORADIAN)
