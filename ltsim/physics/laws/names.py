"""Names of catalogue effects that laws are equivalent to, such as `index-drift` for a decaying vertical index."""

from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor

CATALOGUE_NAMES = {
    **{("vertical index", clock): "index-drift" for clock in CLOCK_COVARIATES},
    **{("azimuth", clock): "azimuth-drift" for clock in CLOCK_COVARIATES},
    **{("distance", clock): "range-drift" for clock in CLOCK_COVARIATES},
    ("range scale", "time"): "refractivity-drift",
    ("distance", "incidence"): "smr-incidence",
}
"""Catalogue effect by response and covariate, for laws with an equivalent in the catalogue."""
TIME_FUNCTIONS_OF_MOVED_TARGET = ("step", "power", "decay")
"""Functions of time of a target's position that are a step or a creep, which the catalogue contains."""
CIRCLE_RESPONSES = {"azimuth": ("azimuth",), "elevation": ("elevation", "vertical index")}
"""Responses of the graduation of a circle, by circle."""
MIN_HARMONIC_PERIODS_PER_TURN = 2.5
"""Periods per turn from which a wave of a circle is a harmonic of higher than second order; the ordinary calibration
contains the lower orders."""
MIN_GRADUATION_PERIODS_PER_TURN = 20.0
"""Periods per turn from which a wave of a circle is an error of the graduation."""


def catalogue_name(law: EmpiricalLaw) -> str:
    """Catalogue name of a law; `unknown` if there is none."""
    driver, carrier = law.regressor, law.response.name
    if (
        driver.kind == "wave"
        and carrier in CIRCLE_RESPONSES.get(driver.covariates[0], ())
        and driver.constant > MIN_HARMONIC_PERIODS_PER_TURN
    ):
        return (
            "encoder-interpolation"
            if driver.constant > MIN_GRADUATION_PERIODS_PER_TURN
            else f"{driver.covariates[0]}-harmonic"
        )
    if driver.kind == "wave" and carrier == "distance" and driver.covariates == ("distance",):
        return "range-cyclic"
    if driver.kind == "constant" and carrier == "distance" and not law.targets:
        return "reflector-constant" if len(law.stations) == 1 else "range-offset"
    if (
        carrier == "place of targets"
        and len(law.targets) == 1
        and driver.covariates == ("time",)
        and _is_step_or_creep(driver)
    ):
        return "target-moved"
    name = CATALOGUE_NAMES.get((carrier, "".join(driver.covariates)), law.name)
    if law.instruments and name == "refractivity-drift":  # the air is of all
        return law.name
    return name if driver.function in ("decay", "power") else law.name


def _is_step_or_creep(regressor: Regressor) -> bool:
    """True for a single step in time, or a steady or fading motion."""
    if regressor.kind == "pieces":
        return len(regressor.factors) == 1 and _is_step_or_creep(regressor.factors[0])
    return regressor.function in TIME_FUNCTIONS_OF_MOVED_TARGET
