"""Laws in the models of diagnosis.json: sizes with their uncertainty, and the curve."""

from __future__ import annotations

import numpy as np

from ltsim.arrays import Floats
from ltsim.diagnose.schema import Curve, Estimate
from ltsim.laws.columns import waves_of
from ltsim.laws.law import Law
from ltsim.laws.sizes import sizes_of
from ltsim.scene.sightings import Sightings

CURVE, A_CYCLE, MOST_POINTS = 61, 16, 600
"""Points at which a curve is written down, those of each cycle of a wave, and at most."""


def told_of(law: Law, sightings: Sightings, mean: Floats, covariance: Floats) -> tuple[Estimate, ...]:
    """The sizes of a law."""
    return tuple(Estimate(**size._asdict()) for size in sizes_of(law, sightings, mean, covariance))


def curve_of(law: Law, sightings: Sightings, mean: Floats, covariance: Floats) -> Curve | None:
    """What the carrier does over the law's covariate where and how it does most; None where it follows several."""
    driver = law.driver
    if len(driver.covariates) != 1:
        return None
    law, way, means, spread = law.along(mean, covariance, sightings)
    mean, covariance = way @ means, np.einsum("c,ckdl,d->kl", way, spread, way)
    x = sightings.quantities[driver.covariates[0]][law.mask(sightings) > 0]
    if driver.kind in ("wave", "cycle"):
        cycles = float(np.ptp(x)) * driver.constant / (2 * np.pi)
        at = np.linspace(x.min(), x.max(), int(np.clip(A_CYCLE * cycles, CURVE, MOST_POINTS)))
        columns = waves_of(driver.constant * at, driver.size // 2)
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
