"""Null ensembles with given residuals in place of simulated ones."""

from dataclasses import replace

import numpy as np

from ltsim.core.arrays import Floats
from ltsim.diagnosis.null_ensemble import NullEnsemble


def with_trials(probe: NullEnsemble, residuals: Floats) -> NullEnsemble:
    """Ensemble whose simulated recordings have the given residuals (m, t)."""
    parts = probe.probe_vectors[:, :1], residuals, probe.probe_vectors[:, 1 + probe.n_trials :]
    return replace(probe, probe_vectors=np.hstack(parts, dtype=np.float32), n_trials=residuals.shape[1])
