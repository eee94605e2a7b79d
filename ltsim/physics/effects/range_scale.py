from ltsim.core.units import PPM
from ltsim.physics.effects.effect import ChainErrorEffect, ChainErrorTerm, LightPathStage, Parameter, RangePowerBasis


class RangeScale(ChainErrorEffect):
    """Range scale error: the laser frequency or a common refractive index of the air is wrong.

    The correction (true value minus reading) of the range d is Delta_d = s d with the scale error s, the same in both
    faces. Air enters with 0.955 ppm/K, -0.268 ppm/hPa and 0.0085 ppm/%RH (633 nm, 20 C): s = 0.955 ppm/K (T_true -
    T_used) and so on.

    Size: laser 0.1 ppm, absolute distance meter 0.3 ppm, air 0.3 ppm with good weather values and 3 to 5 ppm with bad
    ones; 6.6 ppm if 20 C is entered at 27 C, 26 ppm if sea-level pressure is entered at 850 m altitude.
    Similar to: gauge-scale and every uniform expansion of the targets, exactly. Without a known length it equals the
    scale of the network.
    Separate by: thermometers and a barometer; a second, long length standard of another material.
    Validity: up to 100 ppm.
    Source: Ciddor 1996, Appl. Opt. 35, 1566, doi:10.1364/AO.35.001566 (sensitivities by `effects.ciddor`).
    Validation: validated against the exact kinematic chain in first order, and against the columns of the
    Denavit-Hartenberg chain.
    """

    name = "range-scale"
    light_path_stage = LightPathStage.RANGE
    observables = ("distance",)
    parameters = (
        Parameter("range-scale", "ppm", "fraction by which every range is read too short", 2 * PPM, "range_scale"),
    )
    terms = (ChainErrorTerm("range", RangePowerBasis()),)
