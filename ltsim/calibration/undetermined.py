"""Entries of a calibration result for combinations of parameters that the readings do not determine."""

from collections.abc import Sequence

from ltsim.adjustment.adjustment import Adjustment
from ltsim.adjustment.remedies.undetermined import (
    MeasurementForCombination,
    ParameterCombination,
    measurements_for_undetermined,
)
from ltsim.calibration.combinations import UndeterminedEntry
from ltsim.physics.model.construction import GeometricErrorModel


def undetermined_entries(
    adjustment: Adjustment,
    construction: GeometricErrorModel,
    undetermined_by_instrument: list[list[ParameterCombination]],
    *,
    recommend_measurements: bool,
    suspect_targets: Sequence[str] = (),
) -> tuple[UndeterminedEntry, ...]:
    """Result entries of the combinations of parameters that a recording does not determine, for all instruments.

    With `recommend_measurements` the entries name measurements that would determine the combinations. Targets in
    `suspect_targets`, which may have moved, are not used as ends of a proposed length.
    """
    instruments = adjustment.recording.instruments
    measurements = [[MeasurementForCombination()] * len(group) for group in undetermined_by_instrument]
    if recommend_measurements:
        groups = undetermined_by_instrument
        measurements = measurements_for_undetermined(adjustment, construction, groups, suspect_targets)
    combinations = []
    for i, group in enumerate(undetermined_by_instrument):
        names = construction.instrument_parameter_names(instruments)[i * construction.n_parameters :]
        for direction, (instruction, sentence) in zip(group, measurements[i], strict=True):
            terms = direction.coefficients(names)
            entry = UndeterminedEntry(combination=terms, gain=direction.gain, cure=sentence, measurement=instruction)
            combinations.append(entry)
    return tuple(combinations)
