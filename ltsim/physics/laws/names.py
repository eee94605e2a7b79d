"""Names that the catalogue has for laws: a vertical index that decays is `index-drift`; laws that look like cards."""

from ltsim.physics.laws.law import Law
from ltsim.physics.laws.regressors import CLOCKS

NAMED = {
    **{("vertical index", clock): "index-drift" for clock in CLOCKS},
    **{("azimuth", clock): "azimuth-drift" for clock in CLOCKS},
    **{("distance", clock): "range-drift" for clock in CLOCKS},
    ("range scale", "time"): "refractivity-drift",
    ("distance", "incidence"): "smr-incidence",
}
"""Carriers, and the covariates that they follow, that the catalogue has a card for."""
CIRCLES = {"azimuth": ("azimuth",), "elevation": ("elevation", "vertical index")}
"""Carriers that a wave of a circle's graduation has."""
HARMONIC, GRADUATED = 2.5, 20.0
"""Periods a turn from which a wave of a circle is a harmonic beyond the second, which is estimated anyhow, and from
which it is one of its graduation."""


def name_of(law: Law) -> str:
    """The name that the catalogue has for a law; `unknown` where it has none."""
    driver, carrier = law.driver, law.carrier.name
    if driver.kind == "wave" and carrier in CIRCLES.get(driver.covariates[0], ()) and driver.constant > HARMONIC:
        return "encoder-interpolation" if driver.constant > GRADUATED else f"{driver.covariates[0]}-harmonic"
    if driver.kind == "wave" and carrier == "distance" and driver.covariates == ("distance",):
        return "range-cyclic"
    if driver.kind == "constant" and carrier == "distance" and not law.targets:
        return "range-step" if len(law.stations) == 1 else "range-offset"  # a step is from the start of a visit on
    name = NAMED.get((carrier, "".join(driver.covariates)), law.name)
    if law.instruments and name == "refractivity-drift":  # the air is of all
        return law.name
    return name if driver.function in ("decay", "power") else law.name
