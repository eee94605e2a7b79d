"""Two lists of coordinates with the same axes and spellings of names, and checks of their common points and units."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.core.errors import ModelError, NetworkError
from ltsim.core.notation import names_text
from ltsim.core.units import LENGTH_UNITS, SI_PER_UNIT
from ltsim.geometry.rigid import align_with_scale
from ltsim.recordings.epoch_coordinates import MAX_NAMES_IN_NOTE, EpochCoordinates
from ltsim.recordings.tables.setups import normalised_name
from ltsim.recordings.transcription_errors import MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS


def matched_lists(
    first: EpochCoordinates, second: EpochCoordinates
) -> tuple[EpochCoordinates, EpochCoordinates, list[str]]:
    """Two lists with the same axes and spellings of names, and notes on the differences between the lists.

    Raises ModelError if the lists have no axis in common or different units, and NetworkError without common points.
    """
    axes = "".join(axis for axis in first.axes if axis in second.axes)
    if not axes:
        raise ModelError(
            f"the first list has the axes {first.axes} and the second {second.axes}; no axis is in both lists"
        )
    notes = []
    if first.axes != second.axes:
        notes.append(f"the first list has the axes {first.axes}, the second {second.axes}: only {axes} are compared")
    first, second = (_with_axes(epoch, axes) for epoch in (first, second))
    second, renamed = _with_names_spelled_as(second, first.names)
    _require_common_names(first, second)
    _require_same_units(first, second)
    return first, second, [*notes, *renamed, *_unmatched_names_notes(first, second)]


def with_covariances(
    first: EpochCoordinates, second: EpochCoordinates
) -> tuple[EpochCoordinates, EpochCoordinates, list[str]]:
    """Two lists with covariances, and a note if one of them has none: its coordinates then count as free of errors.

    Raises ModelError if none of the lists has standard deviations.
    """
    lists, lacking = [first, second], [i for i, epoch in enumerate((first, second)) if not epoch.has_covariance]
    if len(lacking) == len(lists):
        raise ModelError(
            "the coordinates of both lists have no standard deviations, without which no motion can be tested; add a "
            "column sigma_mm to one list at least"
        )
    notes = []
    for i in lacking:
        lists[i] = replace(lists[i], covariance=np.zeros_like(lists[i].covariance))
        notes.append(
            f"the {('first', 'second')[i]} list has no standard deviations: its coordinates count as free of errors, "
            f"and the standard deviations are those of the {('second', 'first')[i]} list alone, so that points may be "
            "reported as moved that did not move; add a column sigma_mm"
        )
    return lists[0], lists[1], notes


def _with_axes(epoch: EpochCoordinates, axes: str) -> EpochCoordinates:
    """Epoch with some of its `axes` only."""
    if axes == epoch.axes:
        return epoch
    columns = [epoch.axes.index(axis) for axis in axes]
    rows = np.arange(len(epoch.covariance)).reshape(-1, len(epoch.axes))[:, columns].ravel()
    reduced = replace(epoch, axes=axes, covariance=epoch.covariance[np.ix_(rows, rows)])
    is_compared = np.isin(np.arange(epoch.points.shape[1]), reduced.axis_indices)
    return replace(reduced, points=np.where(is_compared, epoch.points, 0.0))


def _with_names_spelled_as(epoch: EpochCoordinates, names: Sequence[str]) -> tuple[EpochCoordinates, list[str]]:
    """Epoch with point names spelled as in `names` if only case, blanks or leading zeros differ, and a note on this."""
    spellings = {normalised_name(name): name for name in names if name not in epoch.names}
    unmatched_names = [name for name in epoch.names if name not in names]
    normalised = [normalised_name(name) for name in unmatched_names]
    changed = {
        name: spellings[key]
        for name, key in zip(unmatched_names, normalised, strict=True)
        if key in spellings and normalised.count(key) == 1
    }
    if not changed:
        return epoch, []
    renaming_text = names_text([f"'{name}' and '{first}'" for name, first in changed.items()])
    note = f"names that differ only in case, blanks or leading zeros are the same point: {renaming_text}"
    return replace(epoch, names=tuple(changed.get(name, name) for name in epoch.names)), [note]


def _require_common_names(first: EpochCoordinates, second: EpochCoordinates) -> None:
    """Check that two lists have common names of points; raises NetworkError, which gives names of both."""
    if set(first.names).isdisjoint(second.names):
        examples = [names_text(list(epoch.names), MAX_NAMES_IN_NOTE) for epoch in (first, second)]
        raise NetworkError(
            f"no point of the first list ({examples[0]}) has the name of a point of the second ({examples[1]}); give "
            "the same points the same names, in the column that names them"
        )


def _unmatched_names_notes(first: EpochCoordinates, second: EpochCoordinates) -> list[str]:
    """Note, in a list, on points that only one of two lists contains; empty without such points."""
    texts = []
    for ordinal, epoch, other in (("first", first, second), ("second", second, first)):
        names = [name for name in epoch.names if name not in other.names]
        if names:
            texts.append(f"{names_text(names, MAX_NAMES_IN_NOTE)} in the {ordinal}")
    return [f"points that only one list contains are not compared: {', '.join(texts)}"] if texts else []


def _require_same_units(first: EpochCoordinates, second: EpochCoordinates) -> None:
    """Check that the coordinates of two lists have the same unit; raises ModelError.

    The units differ if an alignment with a scale fits, and the scale is the ratio of two units of lengths, both within
    `MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS`.
    """
    common_names = [name for name in first.names if name in second.names]
    if len(common_names) <= first.points.shape[1]:
        return
    before, after = (epoch.points[[epoch.names.index(name) for name in common_names]] for epoch in (first, second))
    arms = [points - points.mean(axis=0) for points in (before, after)]
    extents = [float(np.sqrt(np.mean(arm**2))) for arm in arms]
    units = [SI_PER_UNIT[unit] for unit in LENGTH_UNITS]
    ratios = np.array([a / b for a in units for b in units if not math.isclose(a, b, rel_tol=1e-3)])
    scale = extents[1] / extents[0] if all(extents) else 1.0
    if np.abs(scale / ratios - 1.0).min() > MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS:
        return
    try:
        turn, shift, fitted = align_with_scale(after, before, estimates_scale=True)
    except NetworkError:
        return
    misfit = float(np.sqrt(np.mean((before - (float(fitted) * after @ turn.T + shift)) ** 2)))
    ratio = 1.0 / float(fitted)
    if (
        misfit < MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS * extents[0]
        and np.abs(ratio / ratios - 1.0).min() < MIN_RELATIVE_DISAGREEMENT_OF_WRONG_LENGTHS
    ):
        raise ModelError(
            f"the coordinates of the second list are {ratio:.6g} times those of the first, which is the ratio of two "
            "units of length; give the unit in the titles of both lists, such as x_mm, x_m or x_in"
        )
