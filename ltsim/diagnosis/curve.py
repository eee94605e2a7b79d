"""The curve of a law, as a diagnosis writes it down: what its carrier does over the covariate that it follows."""

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.diagnosis.schema import Curve
from ltsim.physics.laws.columns import fourier_columns
from ltsim.physics.laws.law import Law
from ltsim.scene.sightings import Sightings

CURVE, A_CYCLE, MOST_POINTS = 61, 16, 600
"""Points at which a curve is written down, those of each cycle of a wave, and at most."""


def curve_of(law: Law, sightings: Sightings, mean: Floats, covariance: Floats) -> Curve | None:
    """The curve at the set-up where the law does most, and in that direction; None where it follows several covariates.

    The coefficients have a `mean` (k,) and a `covariance` (k, k) [SI].
    """
    driver = law.driver
    if len(driver.covariates) != 1 or driver.kind == "amounts":
        return None
    law, way, means, spread = law.along(mean, covariance, sightings)
    mean, covariance = way @ means, np.einsum("c,ckdl,d->kl", way, spread, way)
    x = sightings.quantities[driver.covariates[0]][law.mask(sightings) > 0]
    if driver.kind in ("wave", "cycle"):
        cycles = float(np.ptp(x)) * driver.constant / (2 * np.pi)
        at = np.linspace(x.min(), x.max(), int(np.clip(A_CYCLE * cycles, CURVE, MOST_POINTS)))
        columns = fourier_columns(driver.constant * at, driver.size // 2)
    else:
        order = np.argsort(x, kind="stable")
        chosen = order[np.unique(np.linspace(0, len(order) - 1, CURVE).round().astype(int))]
        at, columns = x[chosen], law.columns(sightings)[law.mask(sightings) > 0][chosen]
    factor = law.parameters[0].factor
    sigma = np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", columns, covariance, columns), 0.0))
    values = columns @ mean
    return Curve(
        covariate=driver.covariates[0],
        unit=law.carrier.unit,
        at=tuple(at.tolist()),
        value=tuple((values / factor).tolist()),
        sigma=tuple((sigma / factor).tolist()),
    )
