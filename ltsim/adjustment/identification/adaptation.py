"""Adaptation: a recording adjusted with the errors that were identified in it.

References
----------
Teunissen, Testing theory (2006): adaptation follows detection and identification.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.estimate import adjust_from_state
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import Hypothesis, ReadingShiftChange
from ltsim.adjustment.identification.model_changes import apply_corrections_and_omissions
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording


def adjust_with_causes(
    fit: NetworkFit,
    recording: Recording,
    construction: GeometricErrorModel,
    hypotheses: Sequence[Hypothesis],
    *,
    effects: Sequence[LinearEffect] = (),
    subtracts_changes: bool = False,
    **options: Any,
) -> Adjustment:
    """Adjustment of a recording with identified errors (hypotheses) in its model, started at the state of a fit.

    Parameters
    ----------
    fit : NetworkFit
        Fit that contains the hypotheses.
    recording : Recording
        Recording as it was read.
    construction : GeometricErrorModel
        Geometric error model of the tracker; its parameters are estimated.
    hypotheses : sequence of Hypothesis
        Hypotheses of the fit that the model contains. Of the shifts of readings either all or none are permitted.
    effects : sequence of LinearEffect
        Further effects to estimate; their parameters precede those of the shifts.
    subtracts_changes : bool
        True to subtract the estimated shifts from the readings first. The adjustment estimates the (remaining) shifts
        in both cases, with start values of zero if they are subtracted, otherwise with the estimates of the fit.
    **options
        Options of `adjust_from_state`.
    """
    changed, shifts, values = (
        apply_corrections_and_omissions(recording, hypotheses),
        tuple[LinearEffect, ...](),
        np.zeros(0),
    )
    if any(isinstance(h.model_change, ReadingShiftChange) for h in hypotheses):
        shifts, values = fit.effects, fit.state.extra_parameters
        if subtracts_changes:
            changed = changed.with_readings(fit.correct_recording(recording, keeps_outliers=True).readings)
            values = np.zeros_like(values)
    instrument = np.zeros((len(recording.instruments), construction.n_parameters))
    if construction.n_parameters == fit.state.instrument_parameters.shape[1]:
        instrument = fit.state.instrument_parameters
    effect_values = np.zeros(sum(len(e.parameters) for e in effects))
    start_state = replace(
        fit.state, instrument_parameters=instrument, extra_parameters=np.concatenate([effect_values, values])
    )
    return adjust_from_state(changed, construction, effects=(*effects, *shifts), start_state=start_state, **options)
