"""Changes of a recording by hypotheses: corrected rows, omitted references, subtracted shifts, centring errors."""

from collections.abc import Sequence

import numpy as np

from ltsim.adjustment.identification.hypothesis import (
    CentringChange,
    CoordinateExchange,
    Hypothesis,
    ReadingShiftChange,
    ReferenceOmission,
    RowCorrection,
)
from ltsim.adjustment.reference_values import drop_reference, exchange_coordinates
from ltsim.core.arrays import Floats
from ltsim.recordings.recording import Recording
from ltsim.scene.sightings import Sightings


def start_parameters(hypotheses: Sequence[Hypothesis], size: int, approximate_sizes: Sightings | None) -> Floats:
    """Start values (q,) of the parameters of the shifts."""
    shifts = [h.model_change for h in hypotheses if isinstance(h.model_change, ReadingShiftChange)]
    values = [
        s.start_values if approximate_sizes is not None and s.start_values else (0.0,) * len(s.effect.parameters)
        for s in shifts
    ]
    parameters = np.zeros(size)
    all_values = [v for value in values for v in value]
    parameters[: len(all_values)] = all_values
    return parameters


def subtract_shifts(recording: Recording, hypotheses: Sequence[Hypothesis], approximate_sizes: Sightings) -> Recording:
    """Recording without the shifts of the hypotheses, at their guessed sizes."""
    readings = recording.readings.copy()
    for h in hypotheses:
        if isinstance(h.model_change, ReadingShiftChange) and h.model_change.start_values:
            readings -= h.model_change.effect.reading_change(approximate_sizes, np.array(h.model_change.start_values))
    return recording.with_readings(readings)


def apply_corrections_and_omissions(recording: Recording, hypotheses: Sequence[Hypothesis]) -> Recording:
    """Recording with corrected rows and centring errors, and without rejected reference values."""
    readings, target, face = recording.readings.copy(), recording.target.copy(), recording.face.copy()
    for h in hypotheses:
        if isinstance(h.model_change, RowCorrection):
            rows = h.model_change.rows
            readings[rows], target[rows], face[rows] = (
                h.model_change.readings,
                h.model_change.target_indices,
                h.model_change.faces,
            )
    recording = recording.replace(readings=readings, target=target, face=face)
    for h in hypotheses:
        if isinstance(h.model_change, ReferenceOmission):
            recording = drop_reference(recording, h.model_change.reference_value)
        elif isinstance(h.model_change, CoordinateExchange):
            recording = exchange_coordinates(recording, *h.model_change.target_names)
        elif isinstance(h.model_change, CentringChange):
            centring = (*recording.setup.centring, h.model_change.centring)
            recording = recording.replace(setup=recording.setup.model_copy(update={"centring": centring}))
    return recording
