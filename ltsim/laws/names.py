"""Names that the catalogue has for laws: a vertical index that decays is `index-drift`; laws that look like cards."""

from __future__ import annotations

from ltsim.laws.drivers import CLOCKS
from ltsim.laws.law import Law

NAMED = {
    "vertical index": (CLOCKS, "index-drift"),
    "azimuth": (CLOCKS, "azimuth-drift"),
    "range scale": (("time",), "refractivity-drift"),
    "distance": (("incidence",), "smr-incidence"),
}
"""Carriers, and the covariates that they follow, that the catalogue has a card for."""
CIRCLES = {"azimuth": ("azimuth",), "elevation": ("elevation", "vertical index")}
"""Carriers that a wave of a circle's graduation has."""
GRADUATED = 20.0
"""Periods a turn from which a wave of a circle is one of its graduation, and no harmonic of its eccentricity."""


def name_of(law: Law) -> str:
    """The name that the catalogue has for a law; `unknown` where it has none."""
    driver, carrier = law.driver, law.carrier.name
    if driver.kind == "wave" and carrier in CIRCLES.get(driver.covariates[0], ()) and driver.constant > GRADUATED:
        return "encoder-interpolation"
    if driver.kind == "wave" and carrier == "distance" and driver.covariates == ("distance",):
        return "range-cyclic"
    if driver.kind == "constant" and carrier == "distance" and len(law.stations) == 1 and not law.targets:
        return "range-step"  # from the start of the visit on
    covariates, name = NAMED.get(carrier, ((), law.name))
    if law.instruments and name == "refractivity-drift":  # the air is of all
        return law.name
    return name if driver.function in ("decay", "power") and driver.covariates[0] in covariates else law.name
