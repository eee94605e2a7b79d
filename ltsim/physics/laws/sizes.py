"""Sizes of a law for display: value, standard deviation and unit."""

from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.laws.law import Law
from ltsim.scene.sightings import Sightings


class Size(NamedTuple):
    """Reported size of a law, in its display unit."""

    name: str
    value: float
    sigma: float
    unit: str


def sizes_of(law: Law, sightings: Sightings, mean: Floats, covariance: Floats) -> tuple[Size, ...]:
    """Sizes of a law: amplitude and phase of a wave, a constant, or range and rms of a curve over the pointings.

    For a motion in space all components are given, at the set-up with the largest motion. The coefficients have a
    `mean` (k,) and a `covariance` (k, k) [SI].
    """
    law, way, means, spread = law.along(mean, covariance, sightings)
    ways = law.carrier.ways
    if law.driver.kind == "constant":
        name = "" if law.carrier.units else law.carrier.name
        return tuple(_size(law, f"{name} {w}", means[i, 0], spread[i, 0, i, 0], i) for i, w in enumerate(ways))
    if law.driver.kind == "wave" and len(ways) == 1:
        mean, covariance = means[0], spread[0, :, 0]
        size = float(np.hypot(*mean))
        along = mean / max(size, 1e-300)
        across = np.array([-along[1], along[0]])
        phase = float(np.degrees(np.arctan2(mean[1], mean[0])))
        turn = float(np.degrees(np.sqrt(across @ covariance @ across) / max(size, 1e-300)))
        amplitude = _size(law, "amplitude", np.sqrt(2.0) * size, 2.0 * float(along @ covariance @ along))
        return amplitude, Size("phase", phase, min(turn, 180.0), "deg")
    columns = law.columns(sightings)[law.mask(sightings) > 0]
    each = columns @ means.T
    values = each @ way
    gap = columns[int(np.argmax(values))] - columns[int(np.argmin(values))]
    swings = (
        _size(law, f"swing {w}", float(gap @ means[i]), float(gap @ spread[i, :, i] @ gap), i)
        for i, w in enumerate(ways)
    )
    if law.carrier.units:  # components of several units have no common rms
        return tuple(swings)
    rms = float(np.sqrt(np.mean(np.sum(each**2, axis=1))))
    slope = np.einsum("nc,nk->ck", each, columns) / max(rms * len(each), 1e-300)
    felt = _size(law, "rms", rms, float(np.einsum("ck,ckdl,dl->", slope, spread, slope)))
    return felt, *swings


def _size(law: Law, name: str, value: float, variance: float, way: int = 0) -> Size:
    unit, factor = law.carrier.display(way)
    return Size(name.strip(), float(value) * factor, float(np.sqrt(max(variance, 0.0))) * factor, unit)
