"""Changes of the noise: told from each other and from scatter that repeats, in the same currency as laws."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import logsumexp

from ltsim.adjustment import adjust
from ltsim.adjustment.residual_space import ResidualSpace
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.noise import NoiseHypothesisSet, noise_hypotheses
from ltsim.diagnosis.noise_estimation import with_estimated_sizes
from ltsim.diagnosis.noise_groups import GROUP_VARIANCE_FACTORS
from ltsim.diagnosis.noise_hypothesis import NoiseHypothesis
from ltsim.diagnosis.prior import PRIOR_PROBABILITY_BY_CAUSE_CLASS
from ltsim.diagnosis.repeats import normalised_sum_matrix_of_repeats
from ltsim.diagnosis.selection_state import SelectionState
from ltsim.physics.effects.turbulence import Turbulence
from ltsim.physics.laws.variance import REPEATS_IN_BOTH_FACES, VarianceFunction
from ltsim.physics.model.construction import misalignment_construction
from tests.networks import network


@pytest.fixture(scope="module")
def repeated():
    """The residual space of a recording with three repeats, which pointings are of one pair, and its noise bank."""
    recording, truth = network(repeats=3, seed=6)
    space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction(), start_state=truth.state))
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    return space, recording.station * len(recording.targets) + recording.target, bank


def scattered(space, pair, *, shared):
    """Residuals with scatter of 1.5 sigma, new at each pointing or `shared` by the repeats of a pair."""
    rng = random_stream(1, "scatter")
    count = int(space.is_used_reading.sum())
    noise, common = rng.standard_normal((len(pair), 3)), rng.standard_normal((pair.max() + 1, 3))[pair]
    more = np.zeros((space.n_equations, 1))
    more[:count, 0] = 1.5 * (common if shared else noise)[space.is_used_reading]
    return space.whitened_residuals + space.project(more)[:, 0]


def evidence_of(bank, residual, redundancy):
    """Log evidence of each family."""
    names = (
        *bank.family_names,
        *(
            f"{hypothesis.name} {i}" if i else hypothesis.name
            for i, hypothesis in enumerate(bank.group_noise_hypotheses)
        ),
    )
    return dict(zip(names, bank.log_evidence_by_family(residual[:, None], redundancy)[:, 0], strict=True))


@pytest.mark.parametrize("shared", [True, False])
def test_scatter_that_repeats_is_distinguished_from_noise(repeated, shared):
    space, pair, bank = repeated
    evidence = evidence_of(bank, scattered(space, pair, shared=shared), space.redundancy)
    more = evidence["unknown:noise:repeating"] - evidence["noise-level"]
    assert more > 20.0 if shared else more < -20.0


def test_every_variance_function_is_linear_in_its_size(repeated):
    """The bank scales the pattern of a unit size."""
    space, _, bank = repeated
    for h in bank.hypotheses[::97]:
        if isinstance(h.effect, VarianceFunction):
            unit, sized = (
                h.effect.variance(space.sightings, space.reading_sigmas, np.array([v])) for v in (1.0, h.sizes[0])
            )
            expected = space.reading_sigmas**2 + h.sizes[0] * (unit - space.reading_sigmas**2)
            np.testing.assert_allclose(sized, expected, rtol=1e-12)


@pytest.mark.parametrize("covariate", ["time", "bearing", "distance"])
def test_noise_in_a_band_of_a_covariate_is_detected_in_that_band(repeated, covariate):
    space, _, bank = repeated
    x = space.sightings.covariate_values[covariate]
    band = (-np.pi, -0.75 * np.pi) if covariate == "bearing" else tuple(np.quantile(x, (0.0, 0.25)).tolist())
    inside = (x >= band[0]) & (x <= band[1])
    change = np.zeros((space.n_equations, 1))
    more = (
        2.0
        * random_stream(9, "band").standard_normal(space.is_used_reading.shape)
        * inside[:, None]
        * np.array([0.0, 1.0, 1.0])
    )
    change[: int(space.is_used_reading.sum()), 0] = more[space.is_used_reading]
    residual = space.whitened_residuals + space.project(change)[:, 0]
    best = bank.ranked_noise_hypotheses(residual, space.redundancy, np.zeros((space.n_equations, 0)))[0][1].effect
    at = best.variance(space.sightings, space.reading_sigmas, best.plausible_sizes) > space.reading_sigmas**2
    assert np.mean(at[:, 2] == inside) > 0.8 and best.observables == ("azimuth", "elevation")


def test_shaken_targets_scatter_in_both_angles_as_a_single_change(repeated):
    space, _, bank = repeated
    shaken = space.sightings.target < 6
    more = (
        1.5
        * random_stream(4, "shaken").standard_normal(space.is_used_reading.shape)
        * shaken[:, None]
        * np.array([0.0, 1.0, 1.0])
    )
    change = np.zeros((space.n_equations, 1))
    change[: int(space.is_used_reading.sum()), 0] = more[space.is_used_reading]
    residual = space.whitened_residuals + space.project(change)[:, 0]
    first = bank.ranked_noise_hypotheses(residual, space.redundancy, np.zeros((space.n_equations, 0)))[0][1].effect
    assert first.observables == ("azimuth", "elevation")
    assert {space.sightings.target_names.index(name) for name in first.targets} <= set(range(7))


def test_evidence_is_the_restricted_likelihood_of_correlated_residuals(repeated):
    """Against determinants of the whole covariance in coordinates of the residual space."""
    space, pair, bank = repeated
    basis = bank.parameter_basis
    free = np.linalg.svd(np.eye(space.n_equations) - basis @ basis.T)[0][:, : space.n_equations - basis.shape[1]]
    residual = scattered(space, pair, shared=False)
    nothing = np.zeros((space.n_equations, 0))
    sums = bank.averaging_matrix.toarray()
    for i in (0, 20, len(bank.hypotheses) // 2, bank.family_names.index("unknown:noise:repeating")):
        i = int(np.flatnonzero(bank.family_indices == i)[-1]) if i < len(bank.family_names) else i
        grown = np.ones(space.n_equations + len(sums))
        places, logs = bank.variance_factors.affected_rows_and_log_factors(i)
        grown[places] = np.exp(logs)
        covariance = np.diag(grown[: space.n_equations]) + sums.T @ np.diag(grown[space.n_equations :] - 1.0) @ sums
        inner, y = free.T @ covariance @ free, free.T @ residual
        dense = 0.5 * (y @ y - y @ np.linalg.solve(inner, y) - np.linalg.slogdet(inner)[1])
        assert bank.log_restricted_likelihood_ratio(i, residual, nothing) == pytest.approx(dense, rel=1e-3, abs=1e-3)


def test_sizes_between_those_of_the_grid_count_as_much(repeated):
    """Turbulence of a size that no grid holds: each of its two amounts, or both, averaged over the logarithm."""
    space, _, bank = repeated
    effect, used = Turbulence(), space.is_used_reading
    between = np.sqrt(np.prod([sizes[0] for sizes in effect.candidate_parameter_values()[2:4]]))
    true = effect.variance(space.sightings, space.reading_sigmas, np.array([between, 0.0])) / space.reading_sigmas**2
    residual = space.whitened_residuals.copy()
    residual[: int(used.sum())] *= np.sqrt(true[used])

    def gained(k, log_size):
        sizes = np.exp(log_size) * np.eye(2)[k]
        factor = (effect.variance(space.sightings, space.reading_sigmas, sizes) / space.reading_sigmas**2)[used]
        squares, share = residual[: len(factor)] ** 2, space.redundancy[: len(factor)]
        return 0.5 * np.sum(squares * (1.0 - 1.0 / factor) - share * np.log(factor))

    log_evidences = []
    for k in range(2):
        tried = [np.log(sizes[k]) for sizes in effect.candidate_parameter_values() if sizes[k]]
        fine = np.linspace(min(tried), max(tried), 4001)
        logs = np.array([gained(k, x) for x in fine])
        log_evidences.append(logsumexp(logs) - np.log(len(fine)))
    whole = logsumexp([*log_evidences, sum(log_evidences)]) - np.log(3)
    rough = replace(bank, parameter_basis=None)  # in its diagonal form
    evidence_by_family = {
        h.family_name: value
        for value, h in rough.ranked_noise_hypotheses(residual, space.redundancy, np.zeros((space.n_equations, 0)))
    }
    assert evidence_by_family["turbulence"] - bank.log_prior_of_family("turbulence") == pytest.approx(whole, abs=0.1)
    coarse = evidence_of(bank, residual, space.redundancy)["turbulence"]
    assert evidence_by_family["turbulence"] > coarse + 1.0


def test_the_evidence_of_a_noise_level_lets_each_observable_be_by_itself(repeated):
    """One factor for each set of observables, or all subsets with separate factors; each with its sizes averaged."""
    space, _, bank = repeated
    residual, kind = space.whitened_residuals.copy(), np.nonzero(space.is_used_reading)[1]
    for k, times in enumerate((1.3, 1.5, 0.8)):
        residual[: len(kind)][kind == k] *= times

    def averaged(rows):
        square, share = np.sum(residual[: len(kind)][rows] ** 2), np.sum(space.redundancy[: len(kind)][rows])
        return np.log(
            np.mean([np.exp(0.5 * (square * (1 - 1 / f) - share * np.log(f))) for f in GROUP_VARIANCE_FACTORS])
        )

    by_observable = [averaged(kind == k) for k in range(3)]
    subsets = [sum(by_observable[k] for k in range(3) if bits >> k & 1) for bits in range(1, 8)]
    common = [averaged(np.isin(kind, ks)) for ks in ([0], [1], [2], [1, 2], [0, 1, 2])]
    expected = np.log(np.mean([*np.exp(common), np.exp(subsets).mean()]))
    evidence = evidence_of(bank, residual, space.redundancy)["noise-level"]
    assert evidence == pytest.approx(expected + bank.log_prior_of_family("noise-level"), rel=1e-6)


def test_a_wrong_declaration_of_the_noise_has_a_larger_prior_than_a_particular_cause_of_it(repeated):
    """The prior of the noise in the catalogue is divided by the base rates of its effects, and by nothing else."""
    _, _, bank = repeated
    names = "noise-level", "turbulence", "station-noise"
    prior = dict(zip(names, np.exp([bank.log_prior_of_family(name) for name in names]), strict=True))
    assert sum(prior.values()) == pytest.approx(PRIOR_PROBABILITY_BY_CAUSE_CLASS["noise"])
    assert prior["noise-level"] > prior["turbulence"] + prior["station-noise"]
    assert prior["turbulence"] == pytest.approx(prior["station-noise"])


@pytest.mark.parametrize("times", [0.3, 2.5, 7.0])
def test_noise_that_is_larger_everywhere_is_no_turbulence(repeated, times):
    """However the sizes that are tried lie beside the true one."""
    space, _, bank = repeated
    evidence = evidence_of(bank, times * space.whitened_residuals, space.redundancy)
    assert max(evidence, key=lambda family: evidence[family]) == "noise-level"


def test_quiet_residuals_are_no_law(repeated):
    space, _, bank = repeated
    evidence = evidence_of(bank, 0.6 * space.whitened_residuals, space.redundancy)
    assert max(evidence, key=lambda family: evidence[family]) == "noise-level"


def test_residuals_that_a_flexible_law_has_fitted_are_not_quiet(repeated):
    """Many columns take their share of the noise: what they leave of redundancy is what quietness is judged by."""
    space, _, bank = repeated
    extended = space.with_design_columns(
        random_stream(3, "columns").standard_normal((space.n_equations, space.n_equations // 4))
    )
    assert evidence_of(bank, extended.whitened_residuals, space.redundancy)["noise-level"] > 5.0
    assert evidence_of(bank, extended.whitened_residuals, extended.redundancy)["noise-level"] < 0.0


def test_nothing_is_detected_without_an_effect(repeated):
    """Each family's evidence is at most its prior, on average over recordings without any change."""
    space, _, bank = repeated
    white = space.project(random_stream(2, "white").standard_normal((space.n_equations, 200)))
    mean = np.log(np.exp(bank.log_evidence_by_family(white, space.redundancy)).mean(axis=1).sum())
    assert mean < np.log(PRIOR_PROBABILITY_BY_CAUSE_CLASS["noise"] + PRIOR_PROBABILITY_BY_CAUSE_CLASS["scatter"]) + 1.0


def test_means_of_repeats_are_of_unit_variance(repeated):
    space, _, _ = repeated
    means = normalised_sum_matrix_of_repeats(space)
    assert means.shape[0] == int(space.is_used_reading.sum()) // 3
    np.testing.assert_allclose((means.multiply(means)).sum(axis=1), 1.0)


def test_without_repetitions_nothing_is_reported():
    recording, truth = network(repeats=1, seed=6)
    space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction(), start_state=truth.state))
    assert normalised_sum_matrix_of_repeats(space).shape[0] == 0


def test_equal_range_errors_in_both_faces_are_no_noise():
    recording, truth = network(faces=2, repeats=1, seed=6)
    space = ResidualSpace.from_adjustment(adjust(recording, misalignment_construction(), start_state=truth.state))
    bank = NoiseHypothesisSet.from_residual_space(space, noise_hypotheses(space.sightings))
    s = space.sightings
    pair = s.station * len(s.target_names) + s.target
    more = {}
    for name, amounts in (("alike", pair), ("each", np.arange(len(pair)))):
        drawn = random_stream(4, name).standard_normal(amounts.max() + 1)[amounts]
        change = np.zeros((len(pair), 3))
        change[:, 0] = 2.0 * drawn
        residuals = (
            space.whitened_residuals
            + space.project(
                np.append(change[space.is_used_reading], np.zeros(space.n_equations - space.is_used_reading.sum()))[
                    :, None
                ]
            )[:, 0]
        )
        evidence = evidence_of(bank, residuals, space.redundancy)
        more[name] = evidence["unknown:noise:repeating"] - evidence["noise-level"]
    assert more["alike"] > 10.0 > -10.0 > more["each"]
    function = VarianceFunction(("distance",), shared_error_repetition=REPEATS_IN_BOTH_FACES)
    assert (function.response_text, function.regressor_text) == ("distance", "station and target")
    assert "in both faces" in function.text


@pytest.mark.parametrize("factor", [3.0, 1000.0])
def test_the_size_of_noise_is_estimated_beyond_the_sizes_that_are_searched(factor: float) -> None:
    """Noise of 1000 times the declared was reported as 20 times, and effects were sought in the rest for a minute."""
    recording, truth = network(faces=2, seed=3)
    drawn = factor * recording.reading_sigmas() * random_stream(1, "noise").standard_normal(recording.readings.shape)
    noisy = recording.replace(readings=recording.readings + drawn)
    adjusted = adjust(noisy, misalignment_construction(), start_state=truth.state)
    state = SelectionState.from_adjustment(adjusted, adjusted.problem.is_used_reading, 0, None)
    level = next(h for _, h in state.ranked_noise_hypotheses(state.empty_model) if h.effect.name == "noise-level")
    estimated = with_estimated_sizes(state.residual_space, noisy.reading_sigmas(), level)
    np.testing.assert_allclose(np.sqrt(1.0 + np.array(estimated.sizes)), factor, rtol=0.25)


def test_a_target_that_no_other_reading_checks_does_not_widen_the_sizes_without_end(repeated) -> None:
    """Their redundancy is a rounding error; where it is negative the likelihood rises with the noise without end."""
    space, _, bank = repeated
    (mixture, *_) = (g for g in bank.group_noise_hypotheses if getattr(g.effect, "group_kind", "") == "target")
    is_first = np.zeros(space.n_equations, dtype=bool)
    is_first[: int(space.is_used_reading.sum())] = (space.sightings.target == 0)[np.nonzero(space.is_used_reading)[0]]
    projector = SimpleNamespace(leverage=lambda: np.where(is_first, 1.0 + 1e-15, 1.0 - space.redundancy))
    unchecked = replace(
        space, projector=projector, whitened_residuals=np.where(is_first, 0.0, space.whitened_residuals)
    )
    estimated = with_estimated_sizes(unchecked, space.reading_sigmas, NoiseHypothesis(mixture.name, mixture.effect, ()))
    assert np.isfinite(estimated.sizes).all() and np.isfinite(estimated.chi2_drop)


@pytest.mark.parametrize("group_kind", ["target", "station", "reading"])
def test_the_likelihood_times_the_occam_factor_of_separate_noise_is_its_evidence(repeated, group_kind: str) -> None:
    """Also where an effect has left a target quiet that was noisy when the change was selected."""
    space, _, bank = repeated
    (mixture, *_) = (g for g in bank.group_noise_hypotheses if getattr(g.effect, "group_kind", "") == group_kind)
    pointing = np.nonzero(space.is_used_reading)[0]
    factors = np.ones(space.n_equations)
    factors[: len(pointing)] = np.where(space.sightings.target[pointing] == 2, 4.0, 1.0)
    occam_factors = []
    for residual in (factors * space.whitened_residuals, space.whitened_residuals):
        case = replace(space, whitened_residuals=residual)
        estimated = with_estimated_sizes(case, space.reading_sigmas, NoiseHypothesis(mixture.name, mixture.effect, ()))
        evidence = mixture.log_evidence(residual[:, None], space.redundancy)[0]
        assert 0.5 * estimated.chi2_drop + estimated.log_occam_factor == pytest.approx(evidence, abs=1e-6)
        occam_factors.append(estimated.log_occam_factor)
    assert occam_factors[0] < occam_factors[1] - 1.0
