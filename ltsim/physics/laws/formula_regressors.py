"""Formulas with at most one constant, which may replace the smooth curve of a covariate in a law."""

from collections.abc import Iterator, Sequence

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.physics.laws.columns import CIRCULAR_COVARIATES
from ltsim.physics.laws.regressors import CLOCK_COVARIATES, Regressor, scalar_regressor
from ltsim.scene.sightings import Sightings

ANGULAR_COVARIATES = ("elevation", "incidence", "nest-direction", "last-azimuth", "last-elevation")
"""Covariates that are angles; a diagnosis tries their sines, cosines and tangents."""
SAW_TOOTH_PERIOD_FRACTIONS = np.array([1.0, 0.5, 0.25, 0.125])
"""Periods of saw-tooth functions that a diagnosis tries, as fractions of the span of the covariate."""
FORMULA_CONSTANT_SPAN_FRACTIONS = np.array([0.05, 0.15, 0.5])
"""Constants of decays, saturations and dead bands that a diagnosis tries, as fractions of the span of the covariate."""


def formula_regressors(sightings: Sightings, covariate: str, *, is_reduced_set: bool = False) -> Iterator[Regressor]:
    """Iterator over formulas of the `covariate` with at most one constant, which a diagnosis tries.

    If `is_reduced_set`, there are fewer formulas, which limits the number of products with other regressors.
    """
    times = FORMULA_CONSTANT_SPAN_FRACTIONS * float(np.ptp(sightings.covariate_values[covariate]))
    circular = covariate in CIRCULAR_COVARIATES
    if circular:
        for order in range(1, 4 if is_reduced_set else 7):
            yield Regressor("wave", (covariate,), constant=float(order))
    function_constants: list[tuple[str, Sequence[float] | Floats]] = (
        [] if circular and is_reduced_set else [("power", (1.0, 2.0))]
    )
    if covariate in ANGULAR_COVARIATES and not (circular and is_reduced_set):
        function_constants += [("sin", (1.0, 2.0, 3.0)), ("cos", (1.0, 2.0, 3.0)), ("tan", (1.0,))]
    function_constants += [("decay", times)] if covariate == "lapse" else []
    if not is_reduced_set:
        function_constants.append(
            ("saw", SAW_TOOTH_PERIOD_FRACTIONS * float(np.ptp(sightings.covariate_values[covariate])))
        )
        function_constants.append(("power", (3.0, -1.0) if covariate == "distance" else (3.0,)))
        function_constants += [("decay", times)] if covariate in CLOCK_COVARIATES else []
        function_constants += [("relaxing", times)] if covariate in (*CLOCK_COVARIATES, "lapse") else []
        function_constants += (
            [("abs", (1.0,)), ("saturated", times), ("fading", times)] if covariate.startswith("move-") else []
        )
        function_constants += [("within", times), ("stuck", times)] if covariate.startswith("move-") else []
        function_constants += [("slack", times)] if covariate.startswith(("move-", "wound-")) else []
    for function, constants in function_constants:
        for constant in constants:
            yield scalar_regressor(covariate, function, float(constant))
