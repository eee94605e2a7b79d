"""Noise hypotheses outside the catalogue: noise that depends on a covariate, a target, or a region of the hall."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from ltsim.diagnosis.noise_groups import NOISY_OBSERVABLE_SETS
from ltsim.physics.laws.places import LawPlace, target_clusters
from ltsim.physics.laws.regressor_library import MAX_SEPARATE_TARGET_AMOUNTS, varying_column_names
from ltsim.physics.laws.variance import REPETITION_KINDS, VarianceFunction, noise_covariate
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.regions import candidate_regions
from ltsim.scene.sightings import Sightings

ADDED_VARIANCES_OF_ALL_READINGS = (0.25, 0.6, 1.5, 4.0, 12.0)
"""Added variances, divided by the declared variance, that a diagnosis tries for all readings."""
ADDED_VARIANCES_AT_PATTERN_MAXIMUM = (2.0, 6.0, 20.0)
"""Added variances, divided by the declared variance, that a diagnosis tries at the maximum of a variance function
(variance as a function of a covariate or place)."""
ADDED_VARIANCES_OF_TARGETS = (3.0, 15.0, 75.0)
"""Added variances, divided by the declared variance, that a diagnosis tries for the readings to a target."""
MAX_POINTINGS_FOR_NOISE_BANDS = 2000
"""Largest number of pointings in a recording for which larger noise in intervals of a covariate is tried, to limit the
computing time."""
NOISY_SECTOR_WIDTHS = (np.pi / 4.0, np.pi / 2.0)
"""Widths [rad] of the sectors of horizontal directions in which the noise may be larger."""
NOISY_COVARIATE_QUANTILES = (0.25, 0.5, 0.75)
"""Thresholds above or below which the noise may be larger, as quantiles of a covariate other than a direction."""
MIN_POINTING_FRACTION_OF_SECTOR = 0.05
"""Smallest fraction of the pointings inside a sector of directions, and also outside it. Sectors with fewer pointings
are not tried."""
NOISY_REGION_SHAPES = ("xyz", "xy", "x", "y")
"""Shapes of the regions of the hall in which lines of sight may have larger noise, given by the axes along which a
region is bounded."""


def candidate_variance_functions(
    sightings: Sightings, instrument_places: Sequence[LawPlace]
) -> Iterator[tuple[str, VarianceFunction, tuple[float, ...]]]:
    """Noise hypotheses (changed noise) outside the catalogue: tuples of name, variance function, sizes to be tried.

    A variance function gives the variance as a function of a covariate or place. `instrument_places` has the set-ups of
    each instrument, if there are several instruments.
    """
    regressors = ["elevation", "distance", "time", "station-time", "move-azimuth", "move-elevation"]
    regressors += ["incidence"] if np.isfinite(sightings.incidence_angle).any() else []
    places = [
        VarianceFunction(),
        *(VarianceFunction(stations=p.stations, instruments=p.instruments) for p in instrument_places),
    ]
    for at, acts, name, falling in product(
        places, NOISY_OBSERVABLE_SETS[:-1], [*regressors, *varying_column_names(sightings)], (False, True)
    ):
        pattern = replace(at, observables=acts, covariates=(name,), decreases_with_covariate=falling)
        yield " and ".join(acts), pattern, ADDED_VARIANCES_AT_PATTERN_MAXIMUM
    if len(sightings) <= MAX_POINTINGS_FOR_NOISE_BANDS:
        for at, acts, (name, band) in product(places, NOISY_OBSERVABLE_SETS, _covariate_bands(sightings)):
            yield (
                "band",
                replace(at, observables=acts, covariates=(name,), covariate_band=band),
                ADDED_VARIANCES_OF_TARGETS,
            )
    names = sightings.target_names
    target_groups = (
        [(t,) for t in range(len(names))] + sorted(target_clusters(sightings))
        if len(names) <= MAX_SEPARATE_TARGET_AMOUNTS
        else []
    )
    for acts in NOISY_OBSERVABLE_SETS:
        for faces in REPETITION_KINDS if acts == ("distance",) and np.ptp(sightings.face) else REPETITION_KINDS[:1]:
            yield "repeating", VarianceFunction(acts, shared_error_repetition=faces), ADDED_VARIANCES_OF_ALL_READINGS
        for group in target_groups:
            yield "target", VarianceFunction(acts, targets=tuple(names[t] for t in group)), ADDED_VARIANCES_OF_TARGETS
    for region, acts in product(
        candidate_regions(sightings, NOISY_REGION_SHAPES), (("distance",), OBSERVABLES[1:], OBSERVABLES)
    ):
        yield (
            "place",
            VarianceFunction(acts, covariates=tuple(region.bounded_axes), region=region),
            ADDED_VARIANCES_OF_TARGETS,
        )


def _covariate_bands(sightings: Sightings) -> Iterator[tuple[str, tuple[float, float]]]:
    """Iterator over pairs of a covariate and an interval of it (two values) in which the noise may be larger."""
    for name, width in product(("azimuth", "bearing"), NOISY_SECTOR_WIDTHS):
        for start in np.arange(0.0, 2.0 * np.pi, 0.5 * width).tolist():
            band = start, start + width
            inside = VarianceFunction(covariates=(name,), covariate_band=band).is_in_band(sightings)
            if MIN_POINTING_FRACTION_OF_SECTOR <= inside.mean() <= 1.0 - MIN_POINTING_FRACTION_OF_SECTOR:
                yield name, band
    names = ["elevation", "distance", "height", "lapse", "move-azimuth", "move-elevation"]
    names += varying_column_names(sightings)
    names += ["incidence"] if np.isfinite(sightings.incidence_angle).any() else []
    for name in names:
        x = noise_covariate(sightings, name)
        low, high = float(x.min()), float(x.max())
        for threshold in np.unique(np.quantile(x, NOISY_COVARIATE_QUANTILES)).tolist():
            if low < threshold < high:
                yield name, (low, threshold)
                yield name, (threshold, high)
