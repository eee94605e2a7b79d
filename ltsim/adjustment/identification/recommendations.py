"""Recommended next actions after identified causes of a misfit, and sentence on the errors that the model corrects."""

from collections.abc import Collection, Iterable, Sequence

from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.core.notation import count_text, names_text
from ltsim.physics.effects.target_moved import TargetMoved, moved_coordinates_sentence

RECOMMENDATION_BY_CAUSE_KIND = {
    "outlier": "Measure again {rows}.",
    "constant-offset": "Check the SMR and the distance constant at {place}; correct the wrong one.",
    "constant-step": "Check the SMR and the distance constant{at_place}, and measure {setups} again.",
    "constant-drift": "Let the tracker{at_place} reach its operating temperature, and measure {setups} again.",
    "scale-error": (
        "Check the temperature, the pressure and the unit of the distances at {place}; correct the distances, and "
        "evaluate the recording again."
    ),
    "centring": "Check the nests and the centring of the reflectors{at_place}, and measure again.",
    "target-moved": "Inspect the nest of {place}, and measure this target again from all set-ups.",
    "station-bump": "Check the tripod of {place}, and measure this set-up again.",
    "station-drift": "Let the tripod of {place} settle, and measure this set-up again.",
    "station-settling": "Let the tripod of {place} settle, and measure this set-up again.",
    "orientation": "Check the clamping of the tracker at {place}, and measure this set-up again.",
    "reflector-seating": "Clean the nest, seat the reflector again, and measure again {rows}.",
    "reflector-radius": "Check the SMR at {place}, and declare its radius.",
    "reference-value": "Check the reference values{at_place} in their source, and correct the wrong one.",
    "reference-scale": "Check the temperature and expansion of the reference lengths, and the scale of the distances.",
    "names": "Correct the names{at_place} in the recording.",
    "unit": "Read the recording again with the right unit{at_place}.",
    "height": "Check the heights of the instrument and of the targets{at_place}, and whether a target moved.",
    "noise-level": "Find the cause of the scatter{at_place}, or declare this noise in setup.toml, [instrument.noise].",
}
"""Sentence on the next action, by kind of cause. `place` is replaced by the names of the stations and targets,
`at_place` by these names after the word "at", `setups` by the set-ups to measure again, `rows` by the pointing with its
row number.
"""
RECOMMENDATION_BY_REFERENCE_KIND = {
    "mark": "Check the height and the centring of set-up {place} over its mark.",
    "level": "Check the level of {place}, and measure this set-up again.",
}
"""Sentence on the next action after a wrong reference value of a set-up, by the kind of the value; for other kinds the
sentence of `RECOMMENDATION_BY_CAUSE_KIND` applies."""
EXCHANGED_NAMES_RECOMMENDATION = "Exchange the names {targets} at {stations} in the recording."
"""Sentence on the next action after the exchange of two targets in the pointings of some set-ups."""
EXCHANGED_COORDINATES_RECOMMENDATION = (
    "Exchange the reference coordinates of {targets} in their source, or the names of both targets in the recording."
)
"""Sentence on the next action after the exchange of two reference points, which all set-ups measured."""
VERTICAL_INDEX_RECOMMENDATION = (
    "Determine the vertical index of the tracker, and measure {place} again in both faces: their mean is free of the "
    "index."
)
"""Sentence on the next action after an offset of the elevations (vertical index) at one set-up."""
INDEX_DRIFT_RECOMMENDATION = (
    "The vertical index differs between set-ups ({stations}), which suggests a drift: run ltsim diagnose."
)
"""Sentence on the next action after offsets of the elevations (vertical index) at several set-ups; `stations` is
replaced by their names."""


def recommendation_for_cause(test: CauseTest) -> str:
    """Sentence on the next action after an identified cause; empty if its kind has no action."""
    return recommendation_at_place(
        test.kind,
        test.where.stations,
        test.where.targets,
        test.rows,
        concerns_vertical_index=_is_vertical_index_error(test),
        reference_kind=test.acts_on if test.kind == "reference-value" else "",
    )


def recommendation_at_place(
    cause_kind: str,
    stations: Sequence[str],
    targets: Sequence[str],
    rows: Sequence[int] = (),
    *,
    concerns_vertical_index: bool = False,
    reference_kind: str = "",
) -> str:
    """Sentence on the next action after a cause of a kind at stations and targets; empty if the kind has no action.

    `rows` are the row numbers, from 1, of the affected pointings. `concerns_vertical_index` is True for an offset or
    step of elevations. `reference_kind` is the kind of a wrong reference value, such as `mark`.
    """
    if cause_kind == "names" and len(targets) == 2:
        sentence = EXCHANGED_NAMES_RECOMMENDATION if stations else EXCHANGED_COORDINATES_RECOMMENDATION
        return sentence.format(targets=names_text(sorted(targets)), stations=names_text(stations))
    names = (*stations, *targets)
    place = names_text(names, len(names)) if names else "the set-ups"
    action = RECOMMENDATION_BY_REFERENCE_KIND.get(reference_kind) if stations else None
    action = action or RECOMMENDATION_BY_CAUSE_KIND.get(cause_kind)
    action = VERTICAL_INDEX_RECOMMENDATION if concerns_vertical_index else action
    row = f" (row {rows[0]})" if len(rows) == 1 else ""
    target_text = names_text(targets, len(targets)) or "the reading"
    reading_text = f"{target_text}{' from ' if stations else ''}{', '.join(stations)}{row}"
    setups = "this set-up" if len(stations) == 1 else "these set-ups" if names else "all set-ups"
    at_place = f" at {place}" if names else ""
    return (action or "").format(place=place, at_place=at_place, rows=reading_text, setups=setups)


def recommendations_for_causes(tests: Iterable[CauseTest]) -> list[str]:
    """Sentences on next actions after all identified causes that are faults, in their order and without repetitions.

    If the vertical index differs at several set-ups, a sentence on its drift is added at the end.
    """
    faults = [test for test in tests if test.is_fault]
    actions = [recommendation_for_cause(test) for test in faults]
    index_errors = (test for test in faults if _is_vertical_index_error(test))
    stations = list(dict.fromkeys(name for test in index_errors for name in test.where.stations))
    if len(stations) > 1:
        actions.append(INDEX_DRIFT_RECOMMENDATION.format(stations=names_text(stations)))
    return list(dict.fromkeys(filter(None, actions)))


def _is_vertical_index_error(test: CauseTest) -> bool:
    """True for an offset or step of elevations, which is an error of the vertical index."""
    return test.kind in ("constant-offset", "constant-step") and test.acts_on == "elevation"


def corrected_faults(tests: Iterable[CauseTest]) -> list[CauseTest]:
    """Identified errors, other than outliers, that the adjusted model of a result corrects."""
    return [test for test in tests if test.is_fault and test.kind != "outlier"]


def modelled_shifts(tests: Iterable[CauseTest]) -> list[CauseTest]:
    """Identified errors, other than outliers, that the adjusted model corrects by a shift with an estimated size."""
    return [test for test in corrected_faults(tests) if test.sigma is not None and test.is_in_model]


def corrections_sentence(tests: Iterable[CauseTest], unused_rows: Collection[int] = ()) -> str:
    """Sentences on the identified errors that the adjusted model of a result corrects, and on those that remain in it.

    They are empty without identified errors. `unused_rows` are the row numbers, from 1, of pointings that the
    adjustment does not use.
    """
    faults = [test for test in corrected_faults(tests) if test.kind != "noise-level"]
    modelled = [test for test in faults if test.is_in_model]
    sentences = [_uncorrected_error_sentence(test, unused_rows) for test in faults if not test.is_in_model]
    if modelled:
        places = dict.fromkeys(name for test in modelled for name in (*test.where.stations, *test.where.targets))
        place_text = f" at {names_text(list(places))}" if places else ""
        dof = sum(test.dof for test in modelled if test.sigma is not None)
        degrees = f", with {count_text(dof, 'degree')} of freedom" if dof else ""
        sentences.append(f"The model corrects {count_text(len(modelled), 'error')}{place_text}{degrees}.")
    if moved := [name for test in modelled if test.kind == TargetMoved.name for name in test.where.targets]:
        sentences.append(moved_coordinates_sentence(moved))
    return " ".join(sentences)


def _uncorrected_error_sentence(test: CauseTest, unused_rows: Collection[int]) -> str:
    """Sentences on an identified error that the model of a result does not correct.

    The error remains in the coordinates, unless all its pointings are among the `unused_rows`.
    """
    if test.kind == "reference-value":
        return f"{test.sentence} This result still uses this value: correct it, and evaluate the recording again."
    if test.rows and set(test.rows) <= set(unused_rows):
        return f"{test.sentence} The coordinates do not contain this error, because these pointings are not used."
    return f"{test.sentence} This error remains in the coordinates."
