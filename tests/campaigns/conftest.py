from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from ltsim.campaigns.trial_calibrators import BatchCalibrator
from ltsim.campaigns.true_network import TrueNetwork
from ltsim.core.units import ARCSECOND
from ltsim.physics.model.construction import GeometricErrorModel, misalignment_construction
from ltsim.physics.model.measurement import sightings_at_state
from ltsim.recordings.references import ReferenceLengths
from ltsim.simulation.draws import EffectDistribution, TrialDistributions
from tests.campaigns.small import FILE


def _load(name: str) -> ModuleType:
    path = Path(__file__).with_name(f"{name}.py")
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


workshop = _load("workshop").workshop


def truth_of(
    construction: GeometricErrorModel | None = None,
    *,
    faces: int = 1,
    effects: tuple[EffectDistribution, ...] = (),
    scale: float = 1.0,
) -> TrueNetwork:
    """The workshop of the tests with errors drawn from the prior, stated noise, paper's resolution."""
    recording, state = workshop(faces=faces)
    built = construction or misalignment_construction()
    sigma = np.array([[p.prior_sigma_from(recording.setup.instrument.prior) for p in built.parameters]])
    population = TrialDistributions(
        sightings=sightings_at_state(recording, state),
        construction=built,
        instrument_names=("",),
        instrument_error_means=np.zeros_like(sigma),
        instrument_error_sigmas=scale * sigma,
        noise_sigmas=recording.reading_sigmas(),
        reference_lengths=ReferenceLengths.from_recording(recording),
        length_target_names=recording.targets,
        effects=effects,
    )
    return TrueNetwork(recording, state, population, np.array([[1e-7, 0.018 * ARCSECOND, 0.018 * ARCSECOND]]))


@pytest.fixture(scope="session")
def make_truth() -> Callable[..., TrueNetwork]:
    return truth_of


@pytest.fixture(scope="session")
def engine() -> BatchCalibrator:
    return BatchCalibrator(truth_of(), misalignment_construction())


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """The file of the small campaign."""
    path = tmp_path / "noise.toml"
    path.write_text(FILE)
    return path
