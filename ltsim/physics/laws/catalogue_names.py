"""Catalogue effects that are equivalent to a law, such as `index-drift` for a vertical index that decays with time."""

from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor

EFFECT_NAME_BY_RESPONSE_AND_COVARIATE = {
    **{("vertical index", clock): "index-drift" for clock in CLOCK_COVARIATES},
    **{("azimuth", clock): "azimuth-drift" for clock in CLOCK_COVARIATES},
    **{("distance", clock): "range-drift" for clock in CLOCK_COVARIATES},
    ("range scale", "time"): "refractivity-drift",
    ("distance", "incidence"): "smr-incidence",
}
"""Name of the catalogue effect that is equivalent to a law (error as a function of covariates), by the pair of the
law's response (changed quantity) and covariate."""
FUNCTIONS_WITH_CATALOGUE_NAME = ("decay", "power", "sin", "cos", "tan")
"""Functions of a covariate for which a law (error as a function of covariates) gets the name of a catalogue effect.
They include sine, cosine and tangent: these differ from powers of an angle by less than a catalogue effect differs
between two instruments."""
TIME_FUNCTIONS_OF_MOVED_TARGET = ("step", "power", "decay")
"""Functions of time for which a law (error as a function of covariates) of the position of a target gets the name
`target-moved`: a step, a steady motion, or a decaying motion."""
RESPONSE_NAMES_BY_CIRCLE = {"azimuth": ("azimuth",), "elevation": ("elevation", "vertical index")}
"""Names of the responses (changed quantities) through which graduation errors act, by the name of the circle."""
MIN_HARMONIC_PERIODS_PER_TURN = 2.5
"""Limit of the number of periods per turn of a wave in the angle of a circle. Above it the wave is called a graduation
harmonic; the ordinary calibration already contains waves with one and two periods per turn."""
MIN_INTERPOLATION_PERIODS_PER_TURN = 20.0
"""Limit of the number of periods per turn of a wave in the angle of a circle. Above it the wave is called an
interpolation error of the encoder, below it a graduation harmonic."""


def equivalent_effect_name(law: EmpiricalLaw) -> str:
    """Name of the catalogue effect that is equivalent to a law (function of covariates); `unknown` if there is none."""
    regressor, response_name = law.regressor, law.response.name
    if (
        regressor.kind == "wave"
        and response_name in RESPONSE_NAMES_BY_CIRCLE.get(regressor.covariates[0], ())
        and regressor.constant > MIN_HARMONIC_PERIODS_PER_TURN
    ):
        return (
            "encoder-interpolation"
            if regressor.constant > MIN_INTERPOLATION_PERIODS_PER_TURN
            else f"{regressor.covariates[0]}-harmonic"
        )
    if regressor.kind == "wave" and response_name == "distance" and regressor.covariates == ("distance",):
        return "range-cyclic"
    if regressor.kind == "constant" and response_name == "distance" and not law.targets:
        return "reflector-constant" if len(law.stations) == 1 else "range-offset"
    if (
        response_name == "position of targets"
        and len(law.targets) == 1
        and regressor.covariates == ("time",)
        and _is_step_or_creep(regressor)
    ):
        return "target-moved"
    name = EFFECT_NAME_BY_RESPONSE_AND_COVARIATE.get((response_name, "".join(regressor.covariates)), law.name)
    if law.instruments and name == "refractivity-drift":  # all instruments share the air
        return law.name
    return name if regressor.function in FUNCTIONS_WITH_CATALOGUE_NAME else law.name


def _is_step_or_creep(regressor: Regressor) -> bool:
    """True for a regressor of time that is a single step, a steady motion or a decaying motion.

    A regressor is a function of covariates to which the error is proportional.
    """
    if regressor.kind == "pieces":
        return len(regressor.factors) == 1 and _is_step_or_creep(regressor.factors[0])
    return regressor.function in TIME_FUNCTIONS_OF_MOVED_TARGET
