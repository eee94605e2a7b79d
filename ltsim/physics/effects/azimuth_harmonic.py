from ltsim.core.units import MICRORADIAN
from ltsim.physics.effects.circles import CircleHarmonic, cos_sin_parameters
from ltsim.physics.effects.effect import LightPathStage


class AzimuthHarmonic(CircleHarmonic):
    """Higher graduation harmonic of the azimuth circle: the lines of its scale are not evenly spaced.

    The correction (true value minus reading) is Delta_azimuth = A cos(m x) + B sin(m x), with the raw azimuth x, the
    order m from 3 up, and the parameters A and B. The error changes its sign with the face for odd m only. The mean of
    several read heads contains only orders that are multiples of their number.

    Size: 0.2 urad in a good circle, 2 urad in a bad one.
    Similar to: noise and errors of single targets; bearing-wobble, radial run-out of order m + 1.
    Separate by: a rotation of the base between stations, which moves the pattern; a repeat, which does not change it.
    Validity: m up to 8; some thirty directions cannot determine higher orders.
    Source: Lu, Graetz, Amin-Shahidi and Smeds 2010, On-axis self-calibration of angle encoders, CIRP Annals 59,
    529-534; Muralikrishnan et al. 2010, J. Res. NIST 115, 291-301, doi:10.6028/jres.115.022 (parity).
    Validation: validated against the exact kinematic chain in first order, face parity and sign.
    """

    name = "azimuth-harmonic"
    light_path_stage = LightPathStage.ENCODERS
    observables = ("azimuth",)
    covariates = ("azimuth",)
    parameters = cos_sin_parameters("azimuth-harmonic", "`order` times the raw azimuth", 2 * MICRORADIAN)
