"""Public function `accept`, and evaluation of measured errors against the manufacturer's limits."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.acceptance.files import (
    JUDGEMENTS_FROM_WORST_TO_BEST,
    AcceptanceFile,
    Judgement,
    TestOutcome,
    combined_judgement,
    group_summaries,
    measured_test_outcome,
)
from ltsim.acceptance.network import NetworkTests, evaluate_network
from ltsim.acceptance.prediction import AcceptancePlan, predicted_result
from ltsim.acceptance.spec import (
    AcceptanceSettings,
    AcceptanceTest,
    load_acceptance,
    read_table_rows,
    validate_acceptance,
)
from ltsim.calibration.calibration import Calibration
from ltsim.calibration.files import read_calibration
from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, reraise_as_input_error, unknown_name_error
from ltsim.core.notation import names_text
from ltsim.core.units import MICROMETRE
from ltsim.physics.model.construction import construction_of_beam_origin
from ltsim.recordings import read
from ltsim.recordings.files import parse_comma_number, safe_excerpt
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import ResultSource

MAX_PREDICTED_TESTS = 2_000
"""Largest number of tests in a prediction. A prediction draws the errors of 2,000 instruments at a time, in arrays of
up to 64 MB."""
MAX_TEST_DRAWS = 3e8
"""Largest product of the number of tests and the number of random draws in a prediction; 3e8 take 23 s."""
MIN_MARGIN_DIVISOR_UM = 1e-3
"""Smallest margin [um] between an error and its limit that is used as a divisor; a smaller margin is replaced by this
value."""
DECISION_RULE_TEXT = (
    "By ISO 14253-1, an error e with the expanded uncertainty U (95 %) is accepted if |e| + U is within its limit, "
    "rejected if |e| - U exceeds it, and otherwise undecided."
)
"""Sentence on the rule by which measured errors are accepted or rejected."""
NETWORK_UNCERTAINTY_TEXT = (
    "The uncertainty U of a length contains that of the adjusted network and that of the errors removed from the "
    "recording. A two-face error needs no reference: its U contains only the uncertainty of the removed errors and "
    "scatter beyond the declared noise, and may be 0."
)
"""Sentences on the content of the expanded uncertainties U of test errors in a network."""


def accept(acceptance: str | Path | Mapping[str, Any] | AcceptanceSettings, folder: str | Path = ".") -> AcceptanceFile:
    """Acceptance tests of a tracker against its manufacturer's limits: prediction, or evaluation of measured errors.

    Parameters
    ----------
    acceptance : str, Path, mapping or AcceptanceSettings
        Acceptance file, or a mapping with its content; a mapping needs no `format`.
    folder : str or Path
        Folder to which the paths in a mapping are relative.

    Raises
    ------
    InputError, RecordError, NetworkError
        When a file is missing or invalid, or does not belong to the planned tests.

    Examples
    --------
    >>> import ltsim as lt
    >>> result = lt.accept({"standard": "asme-b89.4.19-2006", "instrument": "leica-at500"})
    >>> result.error_origin, len(result.tests)
    ('predicted', 74)
    """
    place = Path(folder)
    if isinstance(acceptance, Mapping):
        acceptance = validate_acceptance({"format": "ltsim-acceptance/1", **acceptance}, "acceptance")
    elif not isinstance(acceptance, AcceptanceSettings):
        place, acceptance = Path(acceptance).parent, load_acceptance(Path(acceptance))
    return _predict_or_evaluate(acceptance, place)


def _require_few_draws(n_tests: int, n_trials: int) -> None:
    """Check of the size of a prediction with `n_tests` tests and `n_trials` draws; InputError if it is too large."""
    if n_tests > MAX_PREDICTED_TESTS or n_tests * n_trials > MAX_TEST_DRAWS:
        raise InputError(
            f"{n_tests} tests with {n_trials} trials each, expected at most {MAX_PREDICTED_TESTS} tests and "
            f"{MAX_TEST_DRAWS:.0e} draws in all: give fewer tests, or a smaller number of trials"
        )


def _predict_or_evaluate(acceptance_settings: AcceptanceSettings, folder: Path) -> AcceptanceFile:
    """Prediction of the tests, or evaluation of the measured errors or of the network that the settings name."""
    limits = acceptance_settings.specification_or_data_sheet
    if acceptance_settings.recording is not None:
        recording = read(folder / acceptance_settings.recording)
        network_tests = evaluate_network(recording, limits)
        return evaluated_result(
            network_tests.test_outcomes, acceptance_settings, recording=recording, network_tests=network_tests
        )
    tests = acceptance_settings.make_tests(folder)
    limits_si = limits.to_instrument(acceptance_settings.construction)
    model = construction_of_beam_origin(acceptance_settings.construction)
    if acceptance_settings.measured_errors_file is not None:
        plan = AcceptancePlan(tests, model, limits, limits_si.noise)
        errors = read_measured_outcomes(
            folder / acceptance_settings.measured_errors_file, tests, plan.permissible_errors
        )
        return evaluated_result(
            errors,
            acceptance_settings,
            unmeasured_tests=[t.name for t in tests if t.name not in {e.name for e in errors}],
        )
    calibration = (
        None if acceptance_settings.calibration is None else _load_calibration(folder / acceptance_settings.calibration)
    )
    model = model if calibration is None else calibration.construction
    prior = np.array([p.prior_sigma_from(limits_si.prior) for p in model.parameters])
    if calibration is None:
        mean, covariance = np.zeros(model.n_parameters), np.diag(prior**2)
        of = f"an instrument like the {limits.name or 'nominal'}"
    else:
        mean, covariance = calibration.estimates[0], calibration.covariance
        of = "the instrument without calibration"
        if acceptance_settings.corrected:
            mean, of = mean - calibration.applied_values[0], "the corrected instrument"
    plan = AcceptancePlan(tests, model, limits, limits_si.noise)
    _require_few_draws(len(tests), acceptance_settings.trials)
    outcome = plan.predict(mean, covariance, n_trials=acceptance_settings.trials, seed=acceptance_settings.seed)
    return predicted_result(plan, outcome, prior, acceptance_settings, instrument_description=of)


def _load_calibration(path: Path) -> Calibration:
    """Calibration of the instrument; raises InputError for a file of several instruments."""
    calibration = read_calibration(path)
    if len(calibration.instruments) > 1:
        raise InputError(
            f"{path}: the calibration has {len(calibration.instruments)} instruments; an acceptance test needs one"
        )
    return calibration


@reraise_as_input_error()
def read_measured_outcomes(file: Path, tests: Sequence[AcceptanceTest], limits: Floats) -> list[TestOutcome]:
    """Outcomes of tests from a CSV file of measured errors with columns ``test``, ``error_um``, optionally ``U_um``.

    `limits` (tests,) [m] are the permissible errors of the planned tests. InputError is raised for an unknown or
    repeated test, and for a cell that is no number.
    """
    place = {test.name: i for i, test in enumerate(tests)}
    outcome_by_test: dict[str, TestOutcome] = {}
    for line, row in read_table_rows(file, ("test", "error_um")):
        name = row["test"].strip()
        if name not in place:
            raise InputError(f"{file}: row {line}: {unknown_name_error('test', name, place)}")
        if name in outcome_by_test:
            raise InputError(f"{file}: row {line}: test '{safe_excerpt(name)}' has two rows; keep its largest error")
        numbers = [
            parse_comma_number(row[name], file=file, row=line, column=name) if row.get(name) else float("nan")
            for name in ("error_um", "U_um")
        ]
        if not np.isfinite(numbers[0]):
            raise InputError(f"{file}: row {line}: error_um is empty, expected micrometres")
        i = place[name]
        outcome_by_test[name] = measured_test_outcome(
            name, tests[i].group, numbers[0] * MICROMETRE, float(limits[i]), numbers[1] * MICROMETRE
        )
    if not outcome_by_test:
        raise InputError(f"{file}: no measured errors; expected one row per test")
    return list(outcome_by_test.values())


def evaluated_result(
    test_outcomes: Sequence[TestOutcome],
    acceptance_settings: AcceptanceSettings,
    *,
    unmeasured_tests: Sequence[str] = (),
    recording: Recording | None = None,
    network_tests: NetworkTests | None = None,
) -> AcceptanceFile:
    """Content of `accept.json` for measured errors, with the judgement of all errors, sentence and next actions.

    `unmeasured_tests` names the planned tests without a measured error. For tests in a network, `recording` is the
    recording of the network, and `network_tests` holds its tests (also in `test_outcomes`) and the errors identified in
    the recording.
    """
    judgement = combined_judgement([t.judgement for t in test_outcomes if t.judgement])
    is_valid = network_tests is None or not network_tests.uncorrected_causes
    if not is_valid or (judgement == "accepted" and unmeasured_tests):
        judgement = "undecided"
    sentence = _judgement_sentence(test_outcomes, len(unmeasured_tests))
    actions = _next_actions(test_outcomes, unmeasured_tests, network_tests)
    if network_tests is not None:
        sentence = " ".join((*network_tests.identified_error_sentences, sentence[0].upper() + sentence[1:]))
        judgement_actions = actions if is_valid else ()
        further_actions = network_tests.further_actions(is_rejected=judgement == "rejected")
        actions = (*network_tests.urgent_actions, *judgement_actions, *further_actions)
    content = AcceptanceFile(
        title=acceptance_settings.title,
        error_origin="measured" if recording is None else "network",
        plan_name=acceptance_settings.plan_name if recording is None else "own network",
        specification=acceptance_settings.specification_or_data_sheet,
        judgement=judgement,
        decision_rule=DECISION_RULE_TEXT if recording is None else f"{DECISION_RULE_TEXT} {NETWORK_UNCERTAINTY_TEXT}",
        unmeasured_tests=tuple(unmeasured_tests),
        sentence=sentence,
        next_actions=actions,
        groups=group_summaries(test_outcomes),
        tests=tuple(test_outcomes),
    )
    return (
        content
        if recording is None
        else content.model_copy(update={"recording": ResultSource.from_recording(recording)})
    )


def _worst_outcome_with_judgement(test_outcomes: Sequence[TestOutcome], judgement: Judgement) -> TestOutcome:
    """Outcome with the given `judgement` whose error exceeds its limit most, or is closest to its limit."""
    return max((t for t in test_outcomes if t.judgement == judgement), key=lambda t: t.lower_bound_to_limit_ratio)


def _judgement_sentence(test_outcomes: Sequence[TestOutcome], n_unmeasured_tests: int) -> str:
    """Sentence with the number of errors of each judgement, the worst error, and the number of unmeasured tests."""
    numbers, total = Counter(t.judgement for t in test_outcomes), len(test_outcomes)
    judgement = next(j for j in JUDGEMENTS_FROM_WORST_TO_BEST if numbers[j])
    worst_entry = _worst_outcome_with_judgement(test_outcomes, judgement)
    error_text = f"{worst_entry.error_um:.1f} um" + (
        "" if worst_entry.expanded_uncertainty_um is None else f" +- {worst_entry.expanded_uncertainty_um:.1f} um"
    )
    phrase = f"{worst_entry.name}: {error_text} where {worst_entry.limit_um:.1f} um are permitted"
    if judgement == "rejected":
        exceed = "exceeds its limit" if numbers["rejected"] == 1 else "exceed their limits"
        sentence = f"{numbers['rejected']} of {total} errors {exceed}; the worst is {phrase}"
        sentence += f"; undecided: {numbers['undecided']}" if numbers["undecided"] else ""
    elif judgement == "undecided":
        sentence = f"no error demonstrably exceeds its limit; {numbers['undecided']} of {total} are undecided, "
        sentence += f"because the limit lies within their uncertainty; the closest is {phrase}"
    else:
        sentence = f"all {total} measured errors are within their limits"
    n_without = sum(t.expanded_uncertainty_um is None for t in test_outcomes)
    if n_without:
        sentence += f"; without an uncertainty and compared with their limits alone: {n_without} of {total}"
    return sentence + (f"; tests of the plan that are not measured: {n_unmeasured_tests}" if n_unmeasured_tests else "")


def _next_actions(
    test_outcomes: Sequence[TestOutcome], unmeasured_tests: Sequence[str], network_tests: NetworkTests | None
) -> tuple[str, ...]:
    """Next actions that can change the judgement, the most urgent first.

    Smaller uncertainties and further tests do not change a rejection. `network_tests` is None for errors that were not
    measured in a network.
    """
    rejected = [t for t in test_outcomes if t.judgement == "rejected"]
    if rejected:
        return _actions_after_rejection(rejected) if network_tests is None else (network_tests.action_after_rejection,)
    actions = []
    undecided = [t for t in test_outcomes if t.judgement == "undecided"]
    if undecided:
        how = "Use a better reference or more readings" if network_tests is None else "Measure more rounds"
        actions.append(f"{how}: {_sufficient_uncertainty_text(undecided)}.")
    if unmeasured_tests:
        actions.append(f"Measure the other tests of the plan: {names_text(list(unmeasured_tests), 3)}.")
    return tuple(actions)


def _actions_after_rejection(rejected_outcomes: Sequence[TestOutcome]) -> tuple[str, ...]:
    """Actions after a rejection; a single rejected error is to be measured again, because it may be a blunder."""
    worst = _worst_outcome_with_judgement(rejected_outcomes, "rejected")
    excess = f"{abs(worst.error_um) - (worst.expanded_uncertainty_um or 0.0) - worst.limit_um:.1f} um"
    if len(rejected_outcomes) > 1:
        names = names_text([t.name for t in rejected_outcomes], 3)
        return (f"Have the maker adjust the tracker, and repeat all tests: {names} exceed their limits.",)
    return (
        f"Repeat {worst.name}: it stays rejected unless its error is smaller by {excess} or more.",
        f"If {worst.name} exceeds its limit again, have the maker adjust the tracker, and repeat all tests.",
    )


def _sufficient_uncertainty_text(undecided_outcomes: Sequence[TestOutcome]) -> str:
    """Sentence part on the expanded uncertainty with which the undecided errors would be accepted or rejected.

    With this uncertainty an error beyond its limit is rejected, and the tracker too. If no error is beyond its limit,
    all undecided errors must be accepted; the error with the largest ratio of uncertainty to margin needs the largest
    reduction.
    """

    def margin_um(test_outcome: TestOutcome) -> float:
        """Distance [um] between the absolute error of a test and its limit."""
        return abs(test_outcome.limit_um - abs(test_outcome.error_um))

    def uncertainty_to_margin(test_outcome: TestOutcome) -> float:
        """Ratio of the expanded uncertainty of a test to the distance of its error from the limit."""
        return (test_outcome.expanded_uncertainty_um or 0.0) / max(margin_um(test_outcome), MIN_MARGIN_DIVISOR_UM)

    beyond = [t for t in undecided_outcomes if abs(t.error_um) > t.limit_um]
    entry = min(beyond, key=uncertainty_to_margin) if beyond else max(undecided_outcomes, key=uncertainty_to_margin)
    present = f"{entry.expanded_uncertainty_um:.3g} um"
    needed = f"an expanded uncertainty of {entry.name} below {margin_um(entry):.2g} um (now {present})"
    if beyond:
        return f"{needed} rejects the tracker, because this error of {abs(entry.error_um):.1f} um exceeds its limit"
    count = len(undecided_outcomes)
    if count == 1:
        return f"{needed} accepts it"
    return (
        f"all {count} undecided errors would be accepted with uncertainties {uncertainty_to_margin(entry):.2g} times "
        f"smaller; {needed}"
    )
