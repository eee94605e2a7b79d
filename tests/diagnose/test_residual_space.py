"""Residual space, held-out error and blind spots against brute force."""

import numpy as np
import pytest

from ltsim.adjust import adjust
from ltsim.adjust.residual_space import ResidualSpace, orthonormal
from ltsim.diagnose.bank import Bank, Hypothesis
from ltsim.diagnose.flexible import FlexibleTerm, smooth
from ltsim.diagnose.held_out import held_out_rms, pair_folds, pointing_folds
from ltsim.diagnose.terms import flexible_hypotheses
from ltsim.model.construction import misalignment
from ltsim.randomness import stream
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def space() -> ResidualSpace:
    recording, _ = network(values=drawn(misalignment(), 1), seed=1)
    return ResidualSpace.of(adjust(recording, misalignment()))


def test_the_drop_of_chi2_is_that_of_a_refit(space):
    term = FlexibleTerm((), (), "distance", smooth("azimuth", 6)[4:])
    bank = Bank.of(space, [Hypothesis("three", term, False)])
    drop, rank = bank.drops(space.residual)
    again = adjust(space.adjustment.recording, misalignment(), effects=[term])
    assert rank[0] == 2
    assert drop[0] == pytest.approx(space.adjustment.chi2 - again.chi2, abs=1e-2)


def test_beside_accepted_effects_the_drop_is_that_of_a_joint_refit(space):
    first = FlexibleTerm((), (), "elevation", smooth("time", 3))
    second = FlexibleTerm((), (), "elevation", smooth("distance", 3))
    bank = Bank.of(space, [Hypothesis("second", second, False)])
    extended = space.extended(space.signature(first))
    signature = space.signature(first)
    added = orthonormal(space.project(signature), signature)
    drop, rank = bank.drops(extended.residual, added)
    one = adjust(space.adjustment.recording, misalignment(), effects=[first])
    both = adjust(space.adjustment.recording, misalignment(), effects=[first, second])
    assert rank[0] == 3
    assert drop[0] == pytest.approx(one.chi2 - both.chi2, abs=1e-2)


def test_held_out_error_is_that_of_refits_without_the_fold(space):
    recording = space.adjustment.recording
    folds = pair_folds(space)
    chosen = np.unique(folds)[:6]
    square, count = 0.0, 0
    by_reading = folds.reshape(-1, 3)[:, 0]
    for fold in chosen:
        out = by_reading == fold
        use = np.broadcast_to(~out[:, None], (len(recording), 3))
        rest = adjust(recording, misalignment(), use=use, start=space.adjustment.state)
        full = rest.problem.__class__.of(rest.problem.model)
        system = full.linearise(rest.state)
        held = np.flatnonzero(np.repeat(out, 3))
        rows, gap = system.design[held], system.residual[held]
        spread = rows @ rest.factor.covariance_columns(rows.T.toarray())
        square += float(gap @ np.linalg.solve(np.eye(len(gap)) + spread, gap))
        count += len(gap)
        assert rest.problem.use.sum() == full.use.sum() - len(gap)
    marked = np.where(np.isin(folds, chosen), folds, -1)
    assert held_out_rms(space, marked) == pytest.approx(np.sqrt(square / count), rel=1e-3)


def test_held_out_error_is_one_where_the_model_holds(space):
    assert held_out_rms(space, pointing_folds(space)) == pytest.approx(1.0, abs=0.1)


def test_flexible_terms_are_finite_and_picklable(space):
    import pickle

    hypotheses = flexible_hypotheses(space.sightings)
    assert len({h.family for h in hypotheses}) > 40
    for h in hypotheses[::40]:
        design = h.effect.design(space.sightings)
        assert design.shape == (len(space.sightings), 3, len(h.effect.parameters))
        assert np.isfinite(design).all()
        assert pickle.loads(pickle.dumps(h.effect)) == h.effect


def test_flexible_terms_speak_the_words_of_the_interface(space):
    words = {
        "time",
        "azimuth",
        "elevation",
        "distance",
        "incidence",
        "height",
        "place",
        "temperature",
        "approach",
        "face",
    }
    columns = set(space.sightings.covariates)
    for h in flexible_hypotheses(space.sightings):
        assert set(h.effect.covariates) <= words | columns, h.effect.formula


def test_grown_terms_are_effects_too(space):
    wave = FlexibleTerm((), (), "azimuth", ((("elevation", "cos", 7.0),), (("elevation", "sin", 7.0),)))
    moved = FlexibleTerm((), (), "place", ((("time", "legendre", 1.0), ("z", "along", 1.0)),))
    for term in (wave, moved):
        grown = term.grown(space.sightings)
        assert len(grown) > 10
        for richer in grown:
            design = richer.design(space.sightings)
            assert design.shape == (len(space.sightings), 3, len(richer.columns))
            assert np.isfinite(design).all()
    harmonic = wave.grown(space.sightings)[0]
    assert harmonic.columns[2:] == ((("elevation", "cos", 14.0),), (("elevation", "sin", 14.0),))


def test_simulated_evidence_is_that_of_the_same_residuals(space):
    hypotheses = flexible_hypotheses(space.sightings)[::10]
    bank = Bank.of(space, hypotheses)
    white = space.project(stream(3, "white").standard_normal((space.size, 2)))
    simulated = bank.simulated_evidence(white)
    from ltsim.diagnose.evidence import log_evidence, log_means

    drop, rank = bank.drops(white[:, 1])
    single = log_evidence(drop, rank)
    expected = log_means(single, bank.family, len(bank.families))
    assert simulated[:, 1] == pytest.approx(expected, abs=1e-3)
    for f in (0, 7):
        assert expected[f] == pytest.approx(np.log(np.exp(single[bank.family == f]).mean()))


def test_sizes_do_not_depend_on_the_units_of_other_parameters():
    from ltsim.diagnose.search import estimates

    rng = stream(5, "columns")
    columns, truth = rng.standard_normal((60, 3)), np.array([1.0, -2.0, 3.0])
    units = np.array([1e-9, 1.0, 1e9])
    found = estimates(columns * units, columns * units, columns @ truth)
    np.testing.assert_allclose(found * units, truth, rtol=1e-9)
