"""Errors that readings share, against the least squares of a dense covariance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.adjustment.problem import NetworkProblem
from ltsim.physics.model.construction import ideal_construction
from ltsim.physics.model.measurement import MeasurementModel
from ltsim.physics.model.nuisances import shared_errors
from ltsim.recordings import Recording, read, write
from ltsim.recordings.recording import DISTANCE_KIND_COLUMN, OBSERVABLES
from ltsim.solve.design import to_dense


@pytest.fixture(scope="module")
def recording() -> Recording:
    """A workshop in which the ranges of a station share an error, and with them azimuths; some ranges are flat."""
    plain = lt.simulate("paper-workshop-re-aimed", seed=4).recording
    rng = np.random.default_rng(8)
    columns = dict(plain.covariates)
    for name in ("a", "b"):
        for ending, size in (("distance_mm", 0.03), ("azimuth_arcsec", 4.0), ("elevation_arcsec", 3.0)):
            columns[f"shared_{name}_{ending}"] = size * rng.normal(size=len(plain)) * (plain.station < 3)
    kinds = tuple("horizontal" if row % 3 == 0 else "slope" for row in range(len(plain)))
    cosine = np.where([kind == "horizontal" for kind in kinds], np.abs(np.cos(plain.readings[:, 2])), 1.0)
    flat = plain.readings * np.stack([cosine, np.ones(len(plain)), np.ones(len(plain))], axis=1)
    return plain.replace(readings=flat, covariates=columns, labels={**plain.labels, DISTANCE_KIND_COLUMN: kinds})


def test_it_is_the_adjustment_by_their_covariance(recording: Recording) -> None:
    adjustment = adjust(recording, tested_reference_kinds=())
    (shared,) = shared_errors(recording)
    assert shared.reading_changes_per_sigma.shape == (len(recording), len(OBSERVABLES), 2)
    alone = recording.replace(covariates={n: c for n, c in recording.covariates.items() if not n.startswith("shared_")})
    plain = NetworkProblem.from_model(MeasurementModel(alone, ideal_construction()))
    assert adjustment.dof == plain.dof
    system = plain.linearise(replace(adjustment.state, extra_parameters=np.zeros(0)))
    design, residual, used = to_dense(system.design), system.whitened_residuals.copy(), plain.is_used_reading
    reach = shared.reading_changes_per_sigma[used] / plain.reading_sigmas[used][:, None]
    root = np.linalg.cholesky(np.eye(len(reach)) + reach @ reach.T)
    rows = slice(0, len(reach))
    design[rows], residual[rows] = np.linalg.solve(root, design[rows]), np.linalg.solve(root, residual[rows])
    spread = np.linalg.inv(design.T @ design)
    step = spread @ design.T @ residual
    assert np.abs(step / np.sqrt(np.diag(spread))).max() < 1e-3
    assert adjustment.chi2 == pytest.approx(float(residual @ residual), rel=1e-5)
    at = plain.unknowns.target_columns
    np.testing.assert_allclose(
        adjustment.target_covariances, spread[at[:, :, None], at[:, None, :]], rtol=1e-4, atol=1e-15
    )


def test_columns_stay_and_are_no_circumstance(recording: Recording, tmp_path: Path) -> None:
    write(recording, tmp_path / "native", "native")
    again = read(tmp_path / "native")
    np.testing.assert_allclose(
        shared_errors(again)[0].reading_changes_per_sigma,
        shared_errors(recording)[0].reading_changes_per_sigma,
        rtol=1e-9,
    )
    assert not any(name.startswith("shared_") for name in again.regressor_covariates)
