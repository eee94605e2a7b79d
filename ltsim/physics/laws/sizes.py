"""Displayed sizes of the change of a law: value, standard deviation and unit."""

from typing import NamedTuple

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.scene.sightings import Sightings


class DisplayedSize(NamedTuple):
    """Size of the change of a law (such as the amplitude of a wave) as reported to users.

    A law describes an error as a function of covariates.
    """

    name: str
    """Name of the size, such as `amplitude`, or `swing` (largest minus smallest value)."""
    value: float
    """Value of the size, in `unit`."""
    sigma: float
    """Standard deviation of the value, in `unit`."""
    unit: str
    """Display unit of value and standard deviation."""


def displayed_sizes(
    law: EmpiricalLaw, sightings: Sightings, coefficients: Floats, covariance: Floats
) -> tuple[DisplayedSize, ...]:
    """Sizes of a law: a constant, the amplitude and phase of a wave, or the rms and swing of a curve.

    A law describes an error as a function of covariates. The swing of a curve is its largest minus its smallest value
    in the pointings. For a motion in space all components are listed, at the set-up with the largest motion. The k
    coefficients of the law have the mean `coefficients` (k,) [SI] and the covariance `covariance` (k, k).
    """
    law, main_direction, means, spread = law.law_at_setup_of_largest_effect(coefficients, covariance, sightings)
    ways = law.response.component_names
    if law.regressor.kind == "constant":
        name = "" if law.response.component_units else law.response.name
        return tuple(
            _displayed_size(law, f"{name} {w}", means[i, 0], spread[i, 0, i, 0], i) for i, w in enumerate(ways)
        )
    if law.regressor.kind == "wave" and len(ways) == 1:
        coefficients, covariance = means[0], spread[0, :, 0]
        size = float(np.hypot(*coefficients))
        along = coefficients / max(size, 1e-300)
        across = np.array([-along[1], along[0]])
        phase = float(np.degrees(np.arctan2(coefficients[1], coefficients[0])))
        turn = float(np.degrees(np.sqrt(across @ covariance @ across) / max(size, 1e-300)))
        amplitude = _displayed_size(law, "amplitude", np.sqrt(2.0) * size, 2.0 * float(along @ covariance @ along))
        return amplitude, DisplayedSize("phase", phase, min(turn, 180.0), "deg")
    columns = law.columns(sightings)[law.pointing_indicator(sightings) > 0]
    component_values = columns @ means.T
    values = component_values @ main_direction
    gap = columns[int(np.argmax(values))] - columns[int(np.argmin(values))]
    swings = (
        _displayed_size(law, f"swing {w}", float(gap @ means[i]), float(gap @ spread[i, :, i] @ gap), i)
        for i, w in enumerate(ways)
    )
    if law.response.component_units:  # components of several units have no common rms
        return tuple(swings)
    rms = float(np.sqrt(np.mean(np.sum(component_values**2, axis=1))))
    slope = np.einsum("nc,nk->ck", component_values, columns) / max(rms * len(component_values), 1e-300)
    rms_size = _displayed_size(law, "rms", rms, float(np.einsum("ck,ckdl,dl->", slope, spread, slope)))
    return rms_size, *swings


def _displayed_size(law: EmpiricalLaw, name: str, value: float, variance: float, component: int = 0) -> DisplayedSize:
    """Size of one component of the response in its display unit, from value and variance of its coefficient.

    A law describes an error as a function of covariates. A response is the quantity that a law changes.
    """
    unit, factor = law.response.display_unit_and_factor_on_coefficient(component)
    return DisplayedSize(name.strip(), float(value) * factor, float(np.sqrt(max(variance, 0.0))) * factor, unit)
