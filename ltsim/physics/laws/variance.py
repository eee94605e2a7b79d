"""Variance functions: noise hypotheses that no catalogue effect describes.

Repeated pointings can share an error, and so can all pointings to a reflector that is centred once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ltsim.core.arrays import Bools, Floats, Ints
from ltsim.core.units import MILLIMETRE
from ltsim.physics.effects.linear_effect import CandidateNoiseEffect, Parameter
from ltsim.physics.laws.columns import CIRCULAR_COVARIATES, MEMORY_COVARIATE_PREFIXES
from ltsim.recordings.centring_errors import CentringUncertainty, OccupationGrouping
from ltsim.recordings.recording import OBSERVABLES
from ltsim.scene.regions import HallRegion
from ltsim.scene.sightings import Sightings

REPETITION_KINDS = REPEATS_PER_FACE, REPEATS_IN_BOTH_FACES = ("in each face", "in both faces")
"""Kinds of repeated pointings with the same error: all pointings of a station to a target in one face, or in both
faces."""


MIN_RELATIVE_PATH_IN_REGION = 0.05
"""Largest relative path in a region of the hall of a line of sight that counts as outside it: length within the region,
divided by the longest such length."""
RECENTRING_PHRASE_BY_OCCUPATION_GROUPING: dict[OccupationGrouping, str] = {
    "station": "for each set-up",
    "instrument_setup": "for each occupation by an instrument",
    "target_setup": "at each occupation",
    "day": "each day",
}
"""Phrases for users that say when a reflector is placed on its target again, by the kind of occupation."""


def noise_groups(sightings: Sightings, group_kind: str) -> tuple[tuple[str, ...], Ints]:
    """Names of the groups with separate noise, and the index (n,) of the group of each of n pointings.

    The groups are stations or targets, or single pointings with names such as ``row 1`` for the `group_kind` `reading`.
    """
    if group_kind == "reading":
        return tuple(f"row {i + 1}" for i in range(len(sightings))), np.arange(len(sightings))
    if group_kind == "station":
        return tuple(sightings.station_names), sightings.station
    return tuple(sightings.target_names), sightings.target


def noise_covariate(sightings: Sightings, covariate: str) -> Floats:
    """Values (n,) in n pointings of a covariate on which the noise depends.

    The result is the absolute value of a covariate that depends on earlier pointings.
    """
    values: Floats = sightings.covariate_values[covariate]
    return np.abs(values) if covariate.startswith(MEMORY_COVARIATE_PREFIXES) else values


@dataclass(frozen=True)
class VarianceFunction(CandidateNoiseEffect):
    """Variance function: changed noise that depends on a covariate, or differs by target, station or region.

    variance = sigma^2 (1 + v * pattern), for each reading, with the declared standard deviation sigma, the added
    relative variance v, and a pattern from 0 to 1. Each of `group_names` (targets, stations or pointings) has a
    separate v, and with `has_variance_per_observable` also each observable. For a `region` of the hall the pattern is
    the length of the line of sight in it, divided by the longest such length. With a `covariate_band` the pattern is 1
    if the first covariate is between the first and second limit, the third and fourth, and so on; otherwise it is 0.
    With a region and a band the pattern is the product of both patterns.
    """

    observables: tuple[str, ...] = OBSERVABLES
    """Names of the observables whose noise is changed."""
    covariates: tuple[str, ...] = ()
    """Names of the covariates (such as the time) on which the noise depends."""
    targets: tuple[str, ...] = ()
    """Names of the targets where the noise is changed; empty for all."""
    stations: tuple[str, ...] = ()
    """Names of the stations where the noise is changed; empty for all."""
    instruments: tuple[str, ...] = ()
    """Names of the instruments whose noise is changed; empty for all."""
    decreases_with_covariate: bool = False
    """True if the noise decreases as the covariate increases."""
    shared_error_repetition: str = ""
    """Kind of repeated pointings with the same error: `in each face` or `in both faces`; empty for independent
    errors."""
    group_kind: str = ""
    """Kind of the groups with separate noise: `target`, `station` or `reading`; empty if the noise is common to all."""
    group_names: tuple[str, ...] = ()
    """Names of the targets, stations or pointings with separate noise; empty for all."""
    has_variance_per_observable: bool = False
    """True if each observable has a separate added variance."""
    region: HallRegion | None = None
    """Region of the hall; readings along lines of sight through it have larger noise. None without a region."""
    covariate_band: tuple[float, ...] = ()
    """Limits of the intervals of the first covariate with larger noise, in pairs of lower and upper limit; empty if
    the noise does not depend on intervals."""

    name = "unknown"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Added variances divided by the declared variance: a single one, or one per group and observable."""
        kinds = [f"-{name}" for name in self.observables] if self.has_variance_per_observable else [""]
        names = [f"added-variance{kind} at {name}" for name in self.group_names for kind in kinds]
        return tuple(
            Parameter(n, "", "added variance where the noise is largest, divided by the declared variance", 3.0)
            for n in names or ["added-variance"]
        )

    @property
    def response_text(self) -> str:
        """Name, shown to users, of what changes: `noise`, or the observable whose error repeated pointings share."""
        return self.observables[0] if self.shared_error_repetition and len(self.observables) == 1 else "noise"

    @property
    def regressor_text(self) -> str:
        """Name, shown to users, of what the variance depends on: the covariates, or the kind of groups."""
        return "station and target" if self.shared_error_repetition else self.group_kind or " ".join(self.covariates)

    @property
    def text(self) -> str:
        """Description, shown to users, of the changed noise level."""
        if self.shared_error_repetition:
            again = ", in both faces" if self.shared_error_repetition == REPEATS_IN_BOTH_FACES else ""
            return f"errors of unknown form that recur when a target is measured again{again}"
        if self.region is not None:
            return "larger noise on lines of sight that pass a region of the hall" + (
                " for a time" if self.covariate_band else ""
            )
        if self.group_kind == "reading":
            return "a fraction of the readings with a much larger scatter"
        if self.group_kind:
            what = self.group_kind.replace("station", "set-up")
            return f"noise that differs from {what} to {what}" + (
                ", separately for each observable" if self.has_variance_per_observable else ""
            )
        if not self.covariates:
            return "larger noise"
        if self.covariate_band:
            several = "several intervals" if len(self.covariate_band) > 2 else "an interval"
            return f"larger noise in {several} of {self.covariates[0]}"
        return f"noise that {'falls' if self.decreases_with_covariate else 'grows'} with {self.covariates[0]}"

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the readings of n pointings, from their declared standard deviations `sigma` (n, 3).

        `parameter_values` are the added variances, divided by the declared variance.
        """
        if self.group_kind:
            added = parameter_values.reshape(len(self.group_names), -1)[noise_groups(sightings, self.group_kind)[1]]
            acts = [o in self.observables for o in OBSERVABLES]
            factor = np.ones(sigma.shape)
            factor[:, acts] += added
            return np.asarray(sigma**2 * factor)
        pattern = self.pointing_indicator(sightings)
        if self.region is not None:
            path = self.region.path_lengths(sightings)
            share = path / max(float(path.max(initial=0.0)), 1e-12)
            pattern = pattern * np.where(share > MIN_RELATIVE_PATH_IN_REGION, share, 0.0)
        if self.covariate_band:
            pattern = pattern * self.is_in_band(sightings)
        for name in self.covariates if self.region is None and not self.covariate_band else ():
            x = noise_covariate(sightings, name)
            x = (x - x.min()) / max(float(np.ptp(x)), 1e-12)
            pattern = pattern * ((1 - x) if self.decreases_with_covariate else x) ** 2
        return self._declared_variance_plus_fraction(sigma, parameter_values[0] * pattern)

    def is_in_band(self, sightings: Sightings) -> Bools:
        """Mask (n,) of the pointings whose first covariate lies in one of the intervals of `covariate_band`."""
        name = self.covariates[0]
        x = noise_covariate(sightings, name)
        is_inside = np.zeros(len(x), dtype=bool)
        for low, high in zip(self.covariate_band[::2], self.covariate_band[1::2], strict=True):
            if name in CIRCULAR_COVARIATES:
                is_inside |= np.remainder(x - low, 2.0 * np.pi) <= high - low
            else:
                is_inside |= (x >= low) & (x <= high)
        return is_inside

    def _declared_variance_plus_fraction(self, sigma: Floats, added_fraction: Floats) -> Floats:
        """Variance (n, 3) of n pointings: the declared one, in the `observables` increased by the fraction (n,)."""
        acts = [float(o in self.observables) for o in OBSERVABLES]
        grown: Floats = sigma**2 * (1.0 + added_fraction[:, None] * np.array(acts))
        return grown


def shared_errors_sentence(sigma_text: str) -> str:
    """Sentence for users on centring errors at all set-ups.

    `sigma_text` is the standard deviation of a displacement as text with its unit.
    """
    return (
        f"Repeated pointings of a target from one set-up have common errors of {sigma_text} (standard deviation) along "
        "each axis: the reflectors were placed anew at each set-up (centring), or errors repeat in all rounds. "
        "The repeats are not independent."
    )


@dataclass(frozen=True)
class CentringVariance(VarianceFunction):
    """Noise hypothesis of centring errors: a random displacement of the reflector at each placement on a target.

    All pointings of a placement have the same displacement, so that the variance of single readings does not change.
    The adjustment estimates the displacements as unknowns. Their prior standard deviation is the parameter of the
    hypothesis.
    """

    occupation_grouping: OccupationGrouping = "station"
    """Kind of occupation, which says when a reflector is placed on its target again (such as at every set-up)."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Only parameter of the hypothesis: the standard deviation of the displacements along each axis."""
        return (Parameter("centring", "mm", "standard deviation of a displacement along each axis", MILLIMETRE),)

    @property
    def regressor_text(self) -> str:
        """Name, shown to users, of the covariate of the displacements: the occupation of the target."""
        return "occupation of the target"

    @property
    def text(self) -> str:
        """Description, shown to users, of the centring errors."""
        return f"reflectors that are centred anew {RECENTRING_PHRASE_BY_OCCUPATION_GROUPING[self.occupation_grouping]}"

    def sentence(self, sigma_text: str) -> str:
        """Sentence for users on the centring errors.

        `sigma_text` is the standard deviation of a displacement as text with its unit.
        """
        if self.occupation_grouping == "station":
            return shared_errors_sentence(sigma_text)
        return f"Centring errors: {self.text}, with a standard deviation of {sigma_text} along each axis."

    def variance(self, sightings: Sightings, sigma: Floats, parameter_values: Floats) -> Floats:
        """Variance (n, 3) of the three readings of n pointings: the declared variance, without the displacements."""
        return sigma**2

    def as_declared_uncertainty(self, sigma: float) -> CentringUncertainty:
        """Centring errors with the standard deviation `sigma` [m], as an entry of `setup.toml` declares them."""
        return CentringUncertainty(sigma_mm=sigma / MILLIMETRE, occupation=self.occupation_grouping)
