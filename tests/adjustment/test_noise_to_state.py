"""A recording quieter than stated leads to the figures to state."""

from __future__ import annotations

import re

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.stochastic_model import _secant_step
from ltsim.adjustment.verdict import VerdictCase, noise_declaration_advice, verdict_on
from ltsim.recordings.recording import SIGMA_COLUMNS, Recording
from ltsim.reports.sections import result_section
from tests.networks import network


def loud(factor: float) -> Recording:
    """The test network with a stated noise that is too large by a factor."""
    recording, _ = network(seed=3)
    instrument = recording.setup.instrument
    noise = instrument.noise.model_copy(
        update={key: factor * value for key, value in instrument.noise.model_dump().items()}
    )
    setup = recording.setup.model_copy(update={"instrument": instrument.model_copy(update={"noise": noise})})
    return recording.replace(setup=setup)


def test_each_figure_is_what_the_readings_show() -> None:
    right = network(seed=3)[0].setup.instrument.noise
    judged = verdict_on(adjust(loud(4.0)))
    assert judged.case is VerdictCase.SMALLER_NOISE
    values_by_name = dict(re.findall(r"(\w+) to ([\d.e-]+)", judged.sentence.partition("Set ")[2]))
    assert values_by_name.keys() == {key for key, value in right.model_dump().items() if value}
    for key, value in values_by_name.items():
        assert float(value) == pytest.approx(getattr(right, key), rel=0.25), key


def test_nothing_is_suggested_where_the_noise_is_right() -> None:
    assert noise_declaration_advice(adjust(loud(1.0))) == ""


def test_sigmas_of_rows_are_multiplied() -> None:
    recording = loud(1.0)
    sigma = 3.0 * recording.reading_sigmas()[:, 0] * 1e3
    columns = {**recording.covariates, SIGMA_COLUMNS[0]: np.where(np.isfinite(sigma), sigma, np.nan)}
    advice = noise_declaration_advice(adjust(recording.replace(covariates=columns)))
    assert re.fullmatch(r"Multiply the sigmas of distance by 0\.[23]\d*\.", advice), advice


def test_variance_components_end_at_their_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A converged sequence of steps that shrink by a constant ratio is not ended far from its limit."""
    steps = np.array([0.4, -0.02, 0.3, 0.0])
    assert _secant_step(steps * [0.8, 0.5, 2.0, 0.0], steps, steps) == pytest.approx([1.6, -0.02, 6.0, 0.0])
    assert _secant_step(steps, 0.0 * steps, 0.0 * steps) == pytest.approx(steps)
    recording = loud(4.0)
    components = adjust(recording, noise_grouping="instrument").variance_components
    monkeypatch.setattr("ltsim.adjustment.stochastic_model.GROUP_NOISE_FACTOR_TOLERANCE", 1e-9)
    exact = adjust(recording, noise_grouping="instrument").variance_components
    assert [c.noise_factor for c in components] == pytest.approx([c.noise_factor for c in exact], rel=2e-3)
    assert all(0.2 < c.noise_factor < 0.3 for c in exact[:3])


@pytest.mark.parametrize(
    "factors", [(4.0, 4.0, 4.0), (0.3, 0.3, 0.3), (4.0, 1.0, 1.0), (1.0, 1.0, 3.0), (0.3, 1.0, 1.0), (1.0, 0.3, 1.0)]
)
def test_after_the_advice_was_followed_once_there_is_no_new_advice(factors: tuple[float, float, float]) -> None:
    recording = network(faces=2, seed=3)[0]
    names = ("distance_mm", "distance_ppm", "azimuth_arcsec", "elevation_arcsec")
    right = recording.setup.instrument.noise
    wrong = {name: f * getattr(right, name) for name, f in zip(names, (factors[0], *factors), strict=True)}
    recording = declared(recording, wrong)
    first = lt.adjust(recording).verdict.sentence
    figures = dict(re.findall(r"(\w+_(?:mm|ppm|arcsec)) to ([\d.e-]+)", first))
    assert figures, first
    second = lt.adjust(declared(recording, {name: float(value) for name, value in figures.items()}))
    assert second.verdict.case == "clean", second.verdict.sentence
    assert "[instrument.noise]" not in result_section(second).terminal_text()


def declared(recording: Recording, noise: dict[str, float]) -> Recording:
    """The recording with another declared noise."""
    instrument = recording.setup.instrument
    changed = instrument.model_copy(update={"noise": instrument.noise.model_copy(update=noise)})
    return recording.replace(setup=recording.setup.model_copy(update={"instrument": changed}))
