"""Scope of a finding: observables, stations, targets, instruments and covariates of an effect."""

from ltsim.diagnosis.schema import FindingScope
from ltsim.physics.effects.effect import NoiseEffect
from ltsim.physics.effects.linear_effect import CandidateEffect
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import covariate_names_in_files
from ltsim.physics.laws.variance import VarianceFunction
from ltsim.recordings.recording import OBSERVABLES


def effect_scope(effect: CandidateEffect, default_observables: tuple[str, ...] = ()) -> FindingScope:
    """Scope of an effect: observables, stations, targets, covariates.

    `default_observables` are its observables if the effect itself does not restrict them.
    """
    observables, stations = tuple(effect.observables), effect.stations
    if isinstance(effect, NoiseEffect | VarianceFunction):
        observables = default_observables or observables
    instruments = effect.instruments if isinstance(effect, EmpiricalLaw | VarianceFunction) else ()
    if isinstance(effect, EmpiricalLaw):
        stations = () if effect.has_coefficients_per_setup else stations
        observables = effect.response.observables or default_observables or observables
    return scope_with_names(
        observables=() if set(observables) == set(OBSERVABLES) else observables,
        stations=() if instruments else stations,
        targets=effect.targets,
        instruments=instruments,
        covariates=covariate_names_in_files(effect.covariates),
    )


def scope_with_names(**names_by_kind: tuple[str, ...]) -> FindingScope:
    """Scope with the given names by kind, such as `stations`; all other kinds are empty."""
    return FindingScope(**dict.fromkeys(FindingScope.model_fields, ()) | names_by_kind)
