"""Names of the catalogue effects that laws are equivalent to, such as `index-drift` for a decaying vertical index."""

from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor

EFFECT_NAME_BY_RESPONSE_AND_COVARIATE = {
    **{("vertical index", clock): "index-drift" for clock in CLOCK_COVARIATES},
    **{("azimuth", clock): "azimuth-drift" for clock in CLOCK_COVARIATES},
    **{("distance", clock): "range-drift" for clock in CLOCK_COVARIATES},
    ("range scale", "time"): "refractivity-drift",
    ("distance", "incidence"): "smr-incidence",
}
"""Name of the catalogue effect that is equivalent to a law, by the names of the law's response and covariate."""
FUNCTIONS_WITH_CATALOGUE_NAME = ("decay", "power", "sin", "cos", "tan")
"""Functions of a covariate for which a law gets the name of a catalogue effect. Sine, cosine and tangent are included:
they differ from powers of the angle by less than a catalogue effect differs between two instruments.
"""
TIME_FUNCTIONS_OF_MOVED_TARGET = ("step", "power", "decay")
"""Functions of time that the position of a target may have in the effect `target-moved`: a step, a steady motion, or a
decaying motion."""
RESPONSE_NAMES_BY_CIRCLE = {"azimuth": ("azimuth",), "elevation": ("elevation", "vertical index")}
"""Names of the responses that an error of the graduation of a circle changes, by the name of the circle."""
MIN_HARMONIC_PERIODS_PER_TURN = 2.5
"""Number of periods per turn above which a wave in the angle of a circle is called a harmonic. The ordinary calibration
already contains waves with one and two periods per turn."""
MIN_INTERPOLATION_PERIODS_PER_TURN = 20.0
"""Number of periods per turn above which a wave in the angle of a circle is called an interpolation error of the
encoder. Below it the wave is a harmonic."""


def catalogue_name(law: EmpiricalLaw) -> str:
    """Name of the catalogue effect that a law is equivalent to; `unknown` if there is none."""
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
    """True for a regressor of time that describes a single step, a steady motion, or a decaying motion."""
    if regressor.kind == "pieces":
        return len(regressor.factors) == 1 and _is_step_or_creep(regressor.factors[0])
    return regressor.function in TIME_FUNCTIONS_OF_MOVED_TARGET
