"""Components of a law in a fixed ratio: the best ratio, its evidence, and the law that has it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

from ltsim.adjustment import adjust
from ltsim.core.errors import ModelError
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.component_ratios import best_component_ratio
from ltsim.diagnosis.evidence import log_evidence_of_coefficients
from ltsim.physics.laws.law import EmpiricalLaw
from ltsim.physics.laws.regressors import scalar_regressor, smooth_regressor
from ltsim.physics.laws.responses import RESPONSE_AND_DESIGN_BY_NAME
from ltsim.physics.laws.text_form import law_suffix, parse_law, regressor_text
from ltsim.physics.model.construction import misalignment_construction
from ltsim.recordings.recording import Recording
from tests.networks import drawn, network


@pytest.fixture(scope="module")
def recording() -> Recording:
    return network(faces=2, values=drawn(misalignment_construction(), 1), seed=1)[0]


def planted(n_components: int, coefficients: int, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gram matrix, score, and the true ratio of a signature with one set of coefficients and unit noise."""
    rng = random_stream(7, "ratio", n_components)
    design_columns = rng.standard_normal((200, n_components * coefficients))
    ratio = rng.standard_normal(n_components)
    ratio *= np.sign(ratio[np.argmax(np.abs(ratio))]) / np.linalg.norm(ratio)
    true = size * np.kron(ratio, rng.standard_normal(coefficients))
    residual = design_columns @ true + rng.standard_normal(200)
    return design_columns.T @ design_columns, design_columns.T @ residual, ratio


@pytest.mark.parametrize("n_components", [2, 3, 6])
def test_a_common_ratio_is_selected_and_has_more_evidence_than_separate_coefficients(n_components: int) -> None:
    gram, score, ratio = planted(n_components, 5, 1.0)
    spread = np.full(len(score), 0.5)
    best, *evidence = best_component_ratio(gram, score, spread, n_components)
    np.testing.assert_allclose(best, ratio, atol=0.25)
    assert sum(evidence) > float(log_evidence_of_coefficients(gram, score, spread)) + 1.0


def test_the_evidence_is_the_integral_over_all_ratios() -> None:
    gram, score, _ = planted(2, 4, 0.6)
    spread = np.full(8, 0.5)
    products, scores = gram.reshape(2, 4, 2, 4), score.reshape(2, 4)

    def likelihood(angle: float, top: float) -> float:
        u = np.array([np.cos(angle), np.sin(angle)])
        inner = np.einsum("i,iajb,j->ab", u, products, u)
        return float(np.exp(log_evidence_of_coefficients(inner, u @ scores, spread[:4] * np.sqrt(2.0)) - top))

    best, top, share = best_component_ratio(gram, score, spread, 2)
    middle = float(np.arctan2(best[1], best[0]))
    integral = quad(likelihood, middle - np.pi / 2, middle + np.pi / 2, args=(top + share,), points=[middle])[0]
    assert np.log(integral / np.pi) == pytest.approx(0.0, abs=0.1)


def test_a_law_along_a_ratio_changes_readings_as_separate_coefficients_in_that_ratio_do(recording: Recording) -> None:
    sightings = adjust(recording).sightings
    for each, ratio in ((False, (0.6, 0.0, -0.8)), (True, (0.5, -0.5, 0.25, 0.1, 0.3, 0.2, 0.4, 0.1, 0.35))):
        stations = tuple(sightings.station_names) if each else ()
        free = EmpiricalLaw(
            stations,
            (),
            RESPONSE_AND_DESIGN_BY_NAME["position of the stand"][0],
            smooth_regressor("time"),
            has_coefficients_per_setup=each,
        )
        ratio = (*ratio, *(0.1,) * (free.n_setup_components - len(ratio)))
        fixed = EmpiricalLaw(
            stations, (), free.response, free.regressor, has_coefficients_per_setup=each, component_ratio=ratio
        )
        values = random_stream(3, "values").standard_normal(free.regressor.n_columns)
        np.testing.assert_allclose(
            fixed.design(sightings) @ values, free.design(sightings) @ np.kron(ratio, values), atol=1e-12
        )
        assert len(fixed.parameters) * free.n_setup_components == len(free.parameters)


def test_a_ratio_is_read_as_it_is_written(recording: Recording) -> None:
    stand = RESPONSE_AND_DESIGN_BY_NAME["position of the stand"][0]
    for each in (False, True):
        stations = recording.stations if each else ()
        bare = EmpiricalLaw(stations, (), stand, scalar_regressor("time", "power"), has_coefficients_per_setup=each)
        ratio = tuple(np.round(np.linspace(-0.4, 0.3, bare.n_setup_components), 4).tolist())
        law = EmpiricalLaw(stations, (), stand, bare.regressor, has_coefficients_per_setup=each, component_ratio=ratio)
        assert parse_law("position of the stand", regressor_text(law.regressor) + law_suffix(law), recording) == law
    with pytest.raises(ModelError, match="a ratio of 2 components; expected 3"):
        parse_law("position of the stand", "time, components in the ratio 0.6 / 0.8", recording)
