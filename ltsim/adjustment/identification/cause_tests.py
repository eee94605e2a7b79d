"""List of tests in every result: identified errors and outliers, with their sizes and probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from ltsim.adjustment.identification.cause_selection import INFINITE_GAIN_SUBSTITUTE, CauseSelection, SelectedHypothesis
from ltsim.adjustment.identification.evidence import log_occam_factor_of_shift, log_prior_of_kind
from ltsim.adjustment.identification.fit import NetworkFit
from ltsim.adjustment.identification.hypothesis import (
    CauseHypothesis,
    CauseKind,
    CentringChange,
    CoordinateExchange,
    NoiseFactor,
    ReadingShiftChange,
    ReferenceOmission,
    RowCorrection,
)
from ltsim.adjustment.identification.noise_sentences import estimated_noise_factor, noise_sentence
from ltsim.adjustment.identification.nominal_offsets import offset_cause_text, smr_exchange_text
from ltsim.adjustment.identification.reading_shifts import ReadingShift
from ltsim.adjustment.reference_tests import ERROR_UNITS
from ltsim.adjustment.significance import MIN_REPORTED_PROBABILITY
from ltsim.core.arrays import Floats
from ltsim.core.notation import listing, with_sigma
from ltsim.core.units import ARCSECOND, MICRORADIAN, MILLIMETRE, PPM
from ltsim.physics.effects.target_moved import TargetMoved
from ltsim.physics.laws.centring import shared_errors_sentence
from ltsim.recordings.recording import OBSERVABLES
from ltsim.recordings.result_file import Entry, Finite, OptionalFloat
from ltsim.recordings.times import interval_text


class CausePlace(Entry):
    """Stations and targets at which an error acts; an empty list stands for all."""

    stations: tuple[str, ...] = ()
    """Names of the stations."""
    targets: tuple[str, ...] = ()
    """Names of the targets."""


class AlternativeCause(Entry):
    """Hypothesis that was fitted in place of an accepted hypothesis, for comparison."""

    kind: str
    """Kind of the alternative error, with the same values as `CauseTest.kind`."""
    where: CausePlace
    """Stations or targets at which the alternative error acts."""
    probability: Finite
    """Posterior probability of the alternative."""


class CauseTest(Entry):
    """Test of a hypothesis about an error, in the network with all accepted hypotheses."""

    kind: str
    """Kind of the error: `outlier`, `constant-offset`, `scale-error`, `target-moved`, `station-bump` and so on."""
    acts_on: str
    """Quantity that the error changes: an observable, `position` (of a target or station), a kind of reference value,
    or `noise`."""
    where: CausePlace
    """Stations or targets at which the error acts."""
    statistic: Finite
    """Test statistic: decrease of chi-square; for noise and blunders twice the gain of log evidence."""
    dof: int
    """Number of tested components."""
    p_value: OptionalFloat = None
    """p-value of `statistic`, not corrected for the number of tests."""
    estimate: OptionalFloat = None
    """Estimated size of the error, in `unit`."""
    sigma: OptionalFloat = None
    """Standard deviation of the estimate."""
    unit: str = ""
    """Unit of the estimate and of its standard deviation."""
    rows: tuple[int, ...] = ()
    """Affected rows of the recording, from 1; empty for more than 20 rows."""
    probability: OptionalFloat = None
    """Posterior probability of the hypothesis, where the alternatives and the absence of an error are the other
    cases."""
    alternatives: tuple[AlternativeCause, ...] = ()
    """Hypotheses that were fitted in place of the tested hypothesis and have a posterior probability above 1 %."""
    accepted: bool = True
    """True if the hypothesis is part of the model of the result."""
    sentence: str = ""
    """Result of the test as a sentence."""

    @property
    def is_fault(self) -> bool:
        """True for an accepted cause that a user must act on: all but noise smaller than declared."""
        return self.accepted and not (self.kind == "noise-level" and (self.estimate or 0.0) <= 1.0)


MAX_LISTED_OUTLIERS = 20
"""Largest number of outliers in the list of tests, and of row numbers in one test."""


def cause_tests(selection: CauseSelection) -> tuple[CauseTest, ...]:
    """Tests of the selected hypotheses, the most certain first, followed by tests of the outliers."""
    fit = selection.fit
    return (*(_accepted_test(fit, choice) for choice in selection.selected_hypotheses), *_outlier_tests(fit))


def _accepted_test(fit: NetworkFit, selected_hypothesis: SelectedHypothesis) -> CauseTest:
    """Test of one of the selected hypotheses of a fit."""
    h = selected_hypothesis.hypothesis
    size_entries: dict[str, Any] = {}
    drop, rank = max(2.0 * min(selected_hypothesis.log_evidence_gain, INFINITE_GAIN_SUBSTITUTE), 0.0), 1
    if isinstance(h.model_change, ReadingShiftChange):
        values, covariance = fit.estimate_and_covariance(h)
        drop, rank = fit.estimate_length_in_sigmas(h) ** 2, len(values)
        size_entries = _estimate_sigma_and_unit(h, values, covariance)
    elif isinstance(h.model_change, ReferenceOmission):
        rank = len(h.model_change.reference_value.sigma)
        miss, unit, factor = _misclosure_and_unit(fit, h)
        size_entries = {"estimate": miss / factor, "unit": unit}
    elif isinstance(h.model_change, NoiseFactor):
        size_entries = {"estimate": estimated_noise_factor(fit, h)}
    elif isinstance(h.model_change, CentringChange):
        rank = len(fit.estimate_and_covariance(h)[0])
        size_entries = {"estimate": h.model_change.centring_uncertainty.sigma_mm, "unit": "mm"}
        if (common := fit.common_displacement_length(h)) is not None:
            size_entries |= {"estimate": common.length / MILLIMETRE, "sigma": common.sigma / MILLIMETRE}
    p = (
        float(special.chdtrc(rank, drop))
        if isinstance(h.model_change, ReadingShiftChange | ReferenceOmission)
        else None
    )
    rows = _seating_rows(fit, h) if h.kind == "reflector-seating" else h.row_numbers
    share = selected_hypothesis.posterior_probabilities.tolist()
    alternatives = tuple(
        AlternativeCause(
            kind=other.kind, where=CausePlace(stations=other.stations, targets=other.targets), probability=s
        )
        for (other, _), s in zip(selected_hypothesis.alternatives, share[1:-1], strict=True)
        if s > MIN_REPORTED_PROBABILITY
    )
    return CauseTest(
        kind=reported_kind(fit, h),
        acts_on=h.acts_on,
        where=CausePlace(stations=h.stations, targets=h.targets),
        statistic=drop,
        dof=rank,
        p_value=p,
        rows=rows if len(rows) <= MAX_LISTED_OUTLIERS else (),
        probability=share[0],
        alternatives=alternatives,
        sentence=cause_sentence(fit, h),
        **size_entries,
    )


def reported_kind(fit: NetworkFit, hypothesis: CauseHypothesis) -> CauseKind:
    """Kind under which a hypothesis is reported; displacements of equal length are reported as another SMR radius."""
    if fit.common_displacement_length(hypothesis) is not None:
        return "reflector-radius"
    return hypothesis.kind


def _estimate_sigma_and_unit(
    hypothesis: CauseHypothesis, shift_components: Floats, covariance: Floats
) -> dict[str, Any]:
    """Entries `estimate`, `sigma`, `unit` for the length of p `shift_components` (p,), `covariance` (p, p) [SI]."""
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    unit, factor = ("mm", MILLIMETRE)
    if isinstance(hypothesis.model_change.effect, ReadingShift):
        unit, factor = ("ppm", PPM) if hypothesis.kind == "scale-error" else (unit, factor)
        unit, factor = ("arcsec", ARCSECOND) if hypothesis.acts_on in ("azimuth", "elevation") else (unit, factor)
    if hypothesis.kind == "reference-scale":
        unit, factor = "ppm", PPM
    part, spread = shift_components[:3], covariance[:3, :3]
    estimated_size = float(part[0]) if len(part) == 1 else float(np.linalg.norm(part))
    sigma = float(np.sqrt(max(float(part @ spread @ part), 0.0))) / max(abs(estimated_size), 1e-300)
    return {"estimate": estimated_size / factor, "sigma": sigma / factor, "unit": unit}


def _misclosure_and_unit(fit: NetworkFit, hypothesis: CauseHypothesis) -> tuple[float, str, float]:
    """Misclosure of an excluded reference value [SI], and the name and the size [SI] of its display unit."""
    assert isinstance(hypothesis.model_change, ReferenceOmission)
    misclosure = float(np.linalg.norm(fit.misclosure_of(hypothesis.model_change.reference_value)))
    return misclosure, *ERROR_UNITS.get(hypothesis.model_change.reference_value.kind, ("mm", MILLIMETRE))


REFERENCE_PHRASES = {
    "point": "The reference coordinates of",
    "difference": "The reference difference",
    "length": "The reference length",
    "level": "The level of",
    "yaw": "The azimuth zero of",
    "mark": "The set-up of",
    "scale": "The scale of",
}
"""First words of a sentence on a reference value, by its kind; the name of the value follows them."""


def cause_sentence(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence on an accepted hypothesis with the size of the error and its usual causes."""
    is_centring = isinstance(hypothesis.model_change, CentringChange)
    return (_centring_sentence if is_centring else _shift_or_noise_sentence)(fit, hypothesis)


def _shift_or_noise_sentence(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence on an accepted hypothesis that is not about centring errors."""
    place_names = ", ".join((*hypothesis.stations, *hypothesis.targets))
    if isinstance(hypothesis.model_change, RowCorrection | CoordinateExchange):
        return hypothesis.error_description
    if isinstance(hypothesis.model_change, NoiseFactor):
        return noise_sentence(fit, hypothesis)
    if isinstance(hypothesis.model_change, ReferenceOmission):
        miss, unit, factor = _misclosure_and_unit(fit, hypothesis)
        plural = hypothesis.model_change.reference_value.kind == "point"
        verb, them = ("are", "them") if plural else ("is", "it")
        phrase = f"{REFERENCE_PHRASES[hypothesis.model_change.reference_value.kind]} {hypothesis.error_description}"
        return f"{phrase} {verb} off by {_number_text(miss / factor)} {unit}: check {them}."
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    values, covariance = fit.estimate_and_covariance(hypothesis)
    estimate = _estimate_sigma_and_unit(hypothesis, values, covariance)
    if isinstance(hypothesis.model_change.effect, ReadingShift) and hypothesis.kind != "orientation":
        return _observable_sentence(fit, hypothesis, estimate)
    size_text = f"{with_sigma(abs(estimate['estimate']), estimate['sigma'], estimate['unit'])}"
    effect = hypothesis.model_change.effect
    if hypothesis.kind == "reference-scale":
        causes = "the declared temperature or expansion, or the scale of the distances, is wrong"
        return f"The reference lengths and the distances differ in scale by {size_text}: {causes}."
    if hypothesis.kind == "reflector-radius":
        cause = smr_exchange_text(float(values[0]), float(np.sqrt(covariance[0, 0]))) or "another SMR radius"
        side = "away from" if values[0] > 0 else "towards"
        return (
            f"At {place_names} the centres of the SMRs are displaced by {size_text} "
            f"along the normals of their nests, {side} the nests: {cause}."
        )
    if hypothesis.kind == "reflector-seating":
        rows_text = f"rows {listing([str(row) for row in _seating_rows(fit, hypothesis)])}"
        return (
            f"The reflector at {hypothesis.targets[0]} was displaced by {size_text} while {hypothesis.stations[0]} "
            f"measured it ({rows_text}): dirt in the nest, or another nest."
        )
    if hypothesis.kind == "station-drift":
        return f"Station {place_names} moved at a constant rate during its measurement, by {size_text} in total."
    interval = _interval_text(fit, hypothesis)
    if hypothesis.kind == "orientation":
        return f"The horizontal circle of {place_names} was turned by {size_text} {interval}."
    if hypothesis.kind == "station-bump":
        turn, spread = values[3:], covariance[3:, 3:]
        length = float(np.linalg.norm(turn))
        sigma = float(np.sqrt(max(float(turn @ spread @ turn), 0.0))) / max(length, 1e-300)
        turned = with_sigma(length / MICRORADIAN, sigma / MICRORADIAN, "urad")
        return f"Station {place_names} moved {interval}, by {size_text} and {turned}."
    assert isinstance(effect, TargetMoved)
    components = (values / MILLIMETRE, np.sqrt(np.diag(covariance)) / MILLIMETRE)
    parts = (f"d{axis} {with_sigma(value, sigma)}" for axis, value, sigma in zip("xyz", *components, strict=True))
    state, first_station = fit.state, fit.recording.stations[0]
    is_frame_of_station = np.allclose(
        np.vstack([state.station_positions[:1], state.station_rotations[0] - np.eye(3)]), 0
    )
    axes = f" along the axes of {first_station}" if is_frame_of_station else ""
    return f"Target {place_names} moved {interval}, by {size_text} ({', '.join(parts)} mm{axes})."


def _seating_rows(fit: NetworkFit, hypothesis: CauseHypothesis) -> tuple[int, ...]:
    """Row numbers, from 1, of the pointings to a badly seated reflector from the station of the hypothesis."""
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    is_affected = hypothesis.model_change.effect.pointing_indicator(fit.adjustment.sightings)
    return tuple((np.flatnonzero(is_affected) + 1).tolist())


OBSERVABLE_CAUSE_TEXTS = {
    ("constant-offset", "distance", "station"): "another SMR, or a wrong distance constant",
    ("constant-offset", "distance", "target"): "another SMR or prism",
    ("constant-offset", "elevation", "station"): "the vertical index differs at this set-up",
    ("constant-step", "distance", "station"): "another SMR, or the beam was interrupted",
    ("constant-step", "elevation", "station"): "the vertical index differs afterwards",
    ("constant-drift", "distance", "station"): "a drift of the range zero",
    ("constant-drift", "elevation", "station"): "a drift of the vertical index",
    ("constant-drift", "azimuth", "station"): "the horizontal circle or the tripod head turns",
    ("scale-error", "distance", "station"): "a wrong atmospheric correction or unit at this set-up",
}
"""Usual causes of a shift of one observable, by kind of the error, observable, and `station` or `target`."""


def _observable_sentence(fit: NetworkFit, hypothesis: CauseHypothesis, estimate: dict[str, Any]) -> str:
    """Sentence on a shift of all readings of one observable; `estimate` has its size, standard deviation and unit."""
    place_names = ", ".join((*hypothesis.stations, *hypothesis.targets))
    place, link = ("target", "to") if hypothesis.targets else ("station", "from")
    cause = OBSERVABLE_CAUSE_TEXTS[hypothesis.kind, hypothesis.acts_on, place]
    what, number = f"The {hypothesis.acts_on}s {link} {place_names or 'all stations'}", estimate["estimate"]
    change_text, size_text = (with_sigma(x, estimate["sigma"], estimate["unit"]) for x in (number, abs(number)))
    if hypothesis.kind == "constant-step":
        return f"{what} changed by {change_text} {_interval_text(fit, hypothesis)}: {cause}."
    if hypothesis.kind == "constant-drift":
        assert isinstance(hypothesis.model_change, ReadingShiftChange)
        assert isinstance(hypothesis.model_change.effect, ReadingShift)
        interval = "the measurement" if len(hypothesis.stations) == 1 else "the longest occupation"
        if hypothesis.model_change.effect.drift_interval == "recording":
            interval = "the recording"
        return f"{what} drifted by {change_text} during {interval}: {cause}."
    if hypothesis.acts_on != "distance":
        return f"{what} are {size_text} too {'large' if number > 0 else 'small'}: {cause}."
    if hypothesis.kind == "constant-offset":
        values, covariance = fit.estimate_and_covariance(hypothesis)
        cause = offset_cause_text(float(values[0]), float(np.sqrt(covariance[0, 0]))) or cause
    return f"{what} are {size_text} too {'long' if number > 0 else 'short'}: {cause}."


def _centring_sentence(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Sentence on centring errors at a set-up, on a target, or at all set-ups, with the size of the displacements."""
    assert isinstance(hypothesis.model_change, CentringChange)
    sigma = f"{_number_text(float(f'{hypothesis.model_change.centring_uncertainty.sigma_mm:.2g}'))} mm"
    size_text = f"{sigma} (standard deviation)"
    if hypothesis.targets:
        what = f"The reflector on target {hypothesis.targets[0]} was displaced at random at each set-up"
        return f"{what}, by {size_text} along each axis: check its centring."
    if not hypothesis.stations:
        return shared_errors_sentence(sigma)
    station = hypothesis.stations[0]
    common = fit.common_displacement_length(hypothesis)
    if common is None:
        return (
            f"The reflectors seen from {station} are displaced from their targets at random, "
            f"by {size_text} along each axis: "
            f"the reflectors were not centred, or readings from {station} have errors that repeat in all rounds."
        )
    text = with_sigma(abs(common.length) / MILLIMETRE, common.sigma / MILLIMETRE, "mm")
    direction_text = "away from" if common.length > 0 else "towards"
    cause = smr_exchange_text(common.length, common.sigma) or "another SMR or adaptor"
    return (
        f"At {station} the centres of the SMRs are all displaced by {text}, {direction_text} their nests: {cause}. "
        "Declare the normals of the nests (nest_normal), so that the displacement is estimated along these normals."
    )


def _interval_text(fit: NetworkFit, hypothesis: CauseHypothesis) -> str:
    """Text of the times and row numbers of the two pointings between which an error began."""
    assert isinstance(hypothesis.model_change, ReadingShiftChange)
    effect, s = hypothesis.model_change.effect, fit.adjustment.sightings
    since = effect.onset_time if isinstance(effect, ReadingShift) else getattr(effect, "time", -np.inf)
    is_acting = np.ones(len(s), dtype=bool)
    if hypothesis.stations:
        is_acting &= np.isin(s.station, [s.station_names.index(name) for name in hypothesis.stations])
    if hypothesis.targets:
        is_acting &= np.isin(s.target, [s.target_names.index(name) for name in hypothesis.targets])
    acting_rows = s.measurement_order[is_acting[s.measurement_order]]
    index = int(np.searchsorted(s.time[acting_rows], since))
    if not 0 < index < len(acting_rows):
        return "during its measurement"
    return interval_text(fit.recording, *acting_rows[index - 1 : index + 1].tolist())


def _number_text(value: float) -> str:
    """Text of a number with four significant digits, without exponent."""
    return f"{float(f'{value:.4g}'):.12g}"


def _outlier_tests(fit: NetworkFit) -> list[CauseTest]:
    """Tests of the rejected readings against their predictions by all readings in use, the largest residual first."""
    recording, tests = fit.recording, list[CauseTest]()
    indices = np.argwhere(fit.is_outlier)
    indices = indices[np.argsort(-np.abs(fit.whitened_residuals[fit.is_outlier]))][:MAX_LISTED_OUTLIERS]
    for i, k in indices.tolist():
        station, target = recording.stations[recording.station[i]], recording.targets[recording.target[i]]
        unit, factor = ("mm", MILLIMETRE) if k == 0 else ("arcsec", ARCSECOND)
        prediction_sigma = fit.outlier_prediction_error_sigmas[i, k]
        value, sigma = float(fit.residuals[i, k]), float(fit.problem.sigma[i, k] * prediction_sigma)
        drop = (value / sigma) ** 2
        sentence = (
            f"The {OBSERVABLES[k]} from {station} to {target} (row {i + 1}) is off by "
            f"{with_sigma(abs(value) / factor, sigma / factor, unit)}: measure it again."
        )
        moved = _probability_of_moved_target(fit, i, drop)
        tests.append(
            CauseTest(
                kind="outlier",
                acts_on=OBSERVABLES[k],
                where=CausePlace(stations=(station,), targets=(target,)),
                statistic=drop,
                dof=1,
                p_value=float(special.chdtrc(1, drop)),
                estimate=value / factor,
                sigma=sigma / factor,
                unit=unit,
                rows=(i + 1,),
                probability=1.0 - moved,
                alternatives=(
                    AlternativeCause(kind="target-moved", where=CausePlace(targets=(target,)), probability=moved),
                )
                if moved > MIN_REPORTED_PROBABILITY
                else (),
                sentence=sentence,
            )
        )
    return tests


def _probability_of_moved_target(fit: NetworkFit, row: int, chi2_drop: float) -> float:
    """Posterior probability that an outlier (pointing index `row`) is a motion of its target.

    `chi2_drop` is the decrease of chi-square by the rejection of the outlier. The probability is 0 unless the outlier
    is the last pointing to its target, because later pointings would show the motion.
    """
    s = fit.adjustment.sightings
    same_rows = np.flatnonzero(s.target == s.target[row])
    if same_rows[np.argmax(s.time[same_rows])] != row or len(same_rows) < 2:
        return 0.0
    w = float(np.sqrt(chi2_drop))
    odds = log_prior_of_kind("target-moved", len(s)) - log_prior_of_kind(
        "outlier", int(fit.problem_with_all_readings.is_used_reading.sum())
    )
    odds += (
        float(log_occam_factor_of_shift(w, 3))
        - float(log_occam_factor_of_shift(w, 1))
        + 0.5 * float(np.nansum(fit.adjustment.normalised_residuals[row] ** 2))
    )
    return 1.0 / (1.0 + float(np.exp(-odds)))
