"""Adjustment of a network that models the identified single causes of its misfit (such as a moved station)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from ltsim.adjustment import Adjustment, adjust as adjusted_network
from ltsim.adjustment.identification import (
    CauseSelection,
    CauseTest,
    adjust_with_causes,
    cause_tests,
    identify_causes,
)
from ltsim.adjustment.identification.cause_sentences import cause_sentence
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    NoiseFactorChange,
    ReadingShiftChange,
    ReferenceOmission,
)
from ltsim.adjustment.identification.recommendations import corrected_faults, corrections_sentence
from ltsim.adjustment.prior import ParameterPrior
from ltsim.adjustment.quality import require_usable_adjustment
from ltsim.adjustment.reference_tests import TESTED_KINDS_EXCEPT_SCALE, TESTED_REFERENCE_KINDS
from ltsim.adjustment.stochastic_model import NoiseGrouping
from ltsim.calibration import result
from ltsim.calibration.prior_conflict import MAX_SIGMA0_FOR_WIDENING
from ltsim.calibration.reported_uncertainty import uncertainty_factor
from ltsim.core.errors import ConvergenceError, NetworkError
from ltsim.core.notation import number_text
from ltsim.physics.effects.linear_effect import LinearEffect
from ltsim.physics.model.construction import GeometricErrorModel
from ltsim.recordings.recording import Recording
from ltsim.recordings.result_file import ResultSource


@dataclass(frozen=True)
class IdentifiedNetwork:
    """Adjusted network of a recording, with the identified causes of its misfit in the model."""

    adjustment: Adjustment
    """Adjustment with the identified causes in its model."""
    recording_entry: ResultSource
    """Description of the recording file as it was read."""
    tests: tuple[CauseTest, ...]
    """Tests of the identified causes and of the outliers."""
    uncertainty_factor: float
    """Factor on all standard deviations: sigma0 if the readings contradict the model, otherwise 1."""

    @classmethod
    def from_recording(
        cls,
        recording: Recording,
        construction: GeometricErrorModel,
        *,
        robust: bool = False,
        datum_names: Sequence[str] | None = None,
    ) -> Self:
        """Network of a recording, with the prior in `setup.toml`; `datum_names` are the targets that define the datum.

        Raises NetworkError or ConvergenceError if the network cannot be solved; the message names the next action.
        """
        return cls.from_cause_selection(
            recording, construction, identify_causes(recording), robust=robust, datum_names=datum_names
        )

    @classmethod
    def from_cause_selection(
        cls,
        recording: Recording,
        construction: GeometricErrorModel,
        selection: CauseSelection | None,
        *,
        robust: bool = False,
        datum_names: Sequence[str] | None = None,
    ) -> Self:
        """Network as in `from_recording`, for causes that `identify_causes` already selected for the recording."""
        try:
            adjustment = adjust_with_cause_selection(
                recording, construction, robust, None, datum_names, selection=selection
            )
            adjustment.solution.require_success()
        except ConvergenceError as problem:
            raise ConvergenceError(f"{problem}; run ltsim diagnose on this recording", problem.solution) from problem
        tests = cause_tests_of_adjustment(selection, adjustment)
        return cls(adjustment, ResultSource.from_recording(recording), tests, network_uncertainty_factor(adjustment))

    @property
    def corrections_text(self) -> str:
        """Sentence on the number and place of the identified causes of a misfit in the model; empty without a cause."""
        is_used = self.adjustment.problem.is_used_reading.tolist()
        return corrections_sentence(self.tests, [row for row, used in enumerate(is_used, start=1) if not any(used)])

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on the causes in the model, and on readings that contradict the model; empty without both."""
        return tuple(dict.fromkeys(filter(None, (self.corrections_text, *self.warnings))))

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings on each cause in the model, and on readings that contradict the model, with the next action."""
        faults = corrected_faults(self.tests)
        warnings = [test.sentence for test in faults if test.sentence]
        if self.uncertainty_factor > 1.0:
            warnings.append(
                f"The readings contradict the model: all standard deviations are multiplied by sigma0 = "
                f"{number_text(self.uncertainty_factor, 3)}. If a single cause acts, coordinates may have larger "
                "errors: run ltsim diagnose on the recording."
            )
        return tuple(dict.fromkeys(warnings))


def network_uncertainty_factor(adjustment: Adjustment) -> float:
    """Factor on the standard deviations of a network: sigma0 if the readings contradict the model, otherwise 1."""
    return uncertainty_factor(
        result.fit_entry(adjustment), is_sigma0_credible=result.fit_verdict(adjustment).uses_estimated_noise
    )


def cause_tests_of_adjustment(selection: CauseSelection | None, adjustment: Adjustment) -> tuple[CauseTest, ...]:
    """Tests of the selected causes and of the outliers, which state if the model of an adjustment contains the cause.

    `adjustment` is the result of `adjust_with_cause_selection` for this `selection`, which is None for no causes.
    """
    if selection is None:
        return ()
    tests = cause_tests(selection)
    if selection.requires_adjustment_with_causes:
        return tests
    hypotheses = [choice.hypothesis for choice in selection.selected_hypotheses]
    return tuple(
        test
        if i >= len(hypotheses) or _contains_cause(adjustment, hypotheses[i])
        else test.model_copy(update={"is_in_model": False})
        for i, test in enumerate(tests)
    )


def _contains_cause(adjustment: Adjustment, hypothesis: CauseHypothesis) -> bool:
    """True if the model of an adjustment contains the cause of `hypothesis`, or if this cause is larger noise."""
    change = hypothesis.model_change
    if isinstance(change, ReferenceOmission):
        value = change.reference_value
        return not any(
            (test.kind, test.name) == (value.kind, value.name) and not test.is_excluded
            for test in adjustment.reference_tests
        )
    if isinstance(change, ReadingShiftChange):
        places = [({*effect.stations}, {*effect.targets}) for effect in adjustment.problem.model.effects]
        return ({*hypothesis.stations}, {*hypothesis.targets}) in places
    return isinstance(change, NoiseFactorChange)


def adjust_with_cause_selection(
    recording: Recording,
    construction: GeometricErrorModel,
    robust: bool,
    grouping: NoiseGrouping | None,
    datum: Sequence[str] | None,
    prior: ParameterPrior | None = None,
    selection: CauseSelection | None = None,
    effects: Sequence[LinearEffect] = (),
) -> Adjustment:
    """Adjustment with the options of a calibration, with `effects`, and with the selected causes of a misfit.

    `selection` is the result of `identify_causes`; None for no causes in the model. `robust`, `grouping` (of the
    estimated noise), `datum` and `prior` are as in `ltsim.adjustment.estimate.adjust`.
    """
    how: dict[str, Any] = {"robust": robust, "noise_grouping": grouping, "datum_names": datum, "prior": prior}
    if selection is not None and selection.requires_adjustment_with_causes:
        fit = selection.fit
        how["reading_mask"] = ~(fit.is_outlier & fit.is_gross_reading)
        adjustment = adjust_with_causes(fit, recording, construction, fit.hypotheses, effects=effects, **how)
        adjustment = replace(adjustment, cause_sentences=_cause_sentences(selection))
        require_usable_adjustment(adjustment)
        return _require_available_datum(adjustment, datum)
    has_no_scale_parameter = prior is None or prior.is_fixed.all()
    how["tested_reference_kinds"] = TESTED_REFERENCE_KINDS if has_no_scale_parameter else TESTED_KINDS_EXCEPT_SCALE
    if selection is not None:
        effects = (*effects, *selection.certain_station_motions, *selection.certain_target_motions)
    adjustment = adjusted_network(recording, construction, effects=effects, **how)
    if adjustment.sigma0 >= MAX_SIGMA0_FOR_WIDENING and any(
        test.kind == "scale" for test in adjustment.rejected_references
    ):
        how["tested_reference_kinds"] = (
            TESTED_REFERENCE_KINDS  # lengths so far off that no scale of an instrument is: they count by their ratios
        )
        adjustment = adjusted_network(recording, construction, effects=effects, **how)
    require_usable_adjustment(adjustment)
    if selection is not None and selection.is_consistent and selection.has_shifts_other_than_motions:
        adjustment = replace(adjustment, cause_sentences=_cause_sentences(selection))
    if selection is not None and grouping is None:
        noise_sentences = tuple(cause_sentence(selection.fit, h) for h in selection.larger_noise_hypotheses)
        adjustment = replace(adjustment, noise_sentences=noise_sentences)
    return _require_available_datum(adjustment, datum)


def _cause_sentences(selection: CauseSelection) -> tuple[str, ...]:
    """Sentences on the selected causes of a misfit, from the most to the least certain cause."""
    return tuple(cause_sentence(selection.fit, choice.hypothesis) for choice in selection.selected_hypotheses)


def _require_available_datum(adjustment: Adjustment, datum: Sequence[str] | None) -> Adjustment:
    """Unchanged `adjustment`; raises NetworkError if `datum` is requested although control points define the frame."""
    if datum and not adjustment.problem.free_motions.shape[1]:
        raise NetworkError(
            "the control points define the frame already: leave out the datum, or the coordinates of the control points"
        )
    return adjustment
