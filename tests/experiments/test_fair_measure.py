"""Fair measure of an answer: the share of the true signal that its model takes."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PLACE = "experiments.20_concealed_physics."
hall_of, tracker, measure, network_of, ideal, catalogue = (
    import_module(PLACE + name) for name in ("hall", "tracker", "measure", "network", "ideal", "laws.catalogue")
)


@pytest.fixture(scope="module")
def network() -> Any:
    return network_of.Network.of(hall_of.draw_hall(np.random.default_rng([31, 0])))


def elevation_drift(network: Any) -> Any:
    change = np.zeros((network.hall.n, 3))
    change[:, 2] = 1e-5 * network.hall.time / network.hall.time.max()
    return tracker.Change(reading=change)


@pytest.mark.parametrize(("size", "share"), [(1.0, 1.0), (0.5, 0.75), (0.0, 0.0), (2.0, 0.0)])
def test_explained_fraction_of_a_shift_is_quadratic_in_the_missing_part(
    network: Any, size: float, share: float
) -> None:
    truth = elevation_drift(network)
    model = replace(measure.Model.nothing(network), change=size * truth.reading)
    assert model.explained_fraction(network, truth) == pytest.approx(share, abs=1e-4)


def test_what_the_unknowns_absorb_needs_no_model(network: Any) -> None:
    truth = elevation_drift(network)
    offset = network.design[: network.base.size] @ np.ones(network.design.shape[1])
    whole = network.mean_strengths(np.append(offset, network.design[network.base.size :].sum(axis=1)))
    assert whole.sum() == pytest.approx(0.0, abs=1e-6 * float(offset @ offset))
    assert measure.Model.nothing(network).observables(network, 0.1, noise=False) == set()
    model = replace(measure.Model.nothing(network), change=truth.reading)
    assert model.observables(network, 0.1, noise=False) == {"elevation"}


def test_share_of_noise(network: Any) -> None:
    truth = tracker.Change(variance=np.tile([0.0, 2.0, 0.0], (network.hall.n, 1)))
    nothing = measure.Model.nothing(network)
    perfect = replace(nothing, variance=1.0 + truth.variance)
    assert perfect.explained_fraction(network, truth) == pytest.approx(1.0)
    assert nothing.explained_fraction(network, truth) == pytest.approx(0.0)
    assert perfect.observables(network, 0.1, noise=True) == {"azimuth"}
    assert 0.0 < replace(nothing, variance=np.sqrt(perfect.variance)).explained_fraction(network, truth) < 1.0


def test_share_of_wrong_lengths(network: Any) -> None:
    truth = tracker.Change(lengths=np.array([2e-5, -2e-5]))
    model = replace(measure.Model.nothing(network), lengths=0.5 * truth.lengths)
    assert model.explained_fraction(network, truth) == pytest.approx(0.75)


def test_a_model_is_read_as_it_was_written(network: Any, tmp_path: Path) -> None:
    model = replace(measure.Model.nothing(network), change=elevation_drift(network).reading, notes={"coefficients": 1})
    model.write(tmp_path)
    copy = measure.Model.read(tmp_path, network)
    assert np.allclose(copy.change, model.change, atol=1e-12) and copy.notes == {"coefficients": 1}
    (tmp_path / measure.MODEL).write_text((tmp_path / measure.MODEL).read_text().rsplit("\n", 2)[0] + "\n")
    with pytest.raises(ValueError, match="expected"):
        measure.Model.read(tmp_path, network)


def test_the_ideal_observer_finds_an_easy_law(network: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ideal, "DRAWS", 20)
    monkeypatch.setattr(ideal, "FURTHER_DRAWS", 20)
    laws = {name: catalogue.KNOWN[name] for name in ("index-drift", "range-step", "azimuth-drift")}
    truth = elevation_drift(network)
    size = np.sqrt(600.0 / network.strengths(truth).sum())
    noise = np.random.default_rng(1).standard_normal(len(network.design))
    opinion = ideal.observe(network, noise + network.signature(truth.scaled(size)), laws, np.random.default_rng(2))
    assert opinion.law == "index-drift" and opinion.p_value == 0.01 and opinion.probability > 0.9
    change = opinion.change[: network.base.size].reshape(-1, 3) * network.hall.sigma
    assert replace(measure.Model.nothing(network), change=change).explained_fraction(network, truth.scaled(size)) > 0.95
