"""Findings from tests, which need no search: blunders, wrong reference values, contradicting instrument constants."""

import numpy as np

from ltsim.adjustment.blunders import IdentifiedBlunder
from ltsim.adjustment.identification import CauseTest
from ltsim.adjustment.reference_tests import ReferenceTest
from ltsim.core.notation import with_sigma
from ltsim.core.units import MILLIMETRE
from ltsim.diagnosis.hypotheses import probability_and_equivalents
from ltsim.diagnosis.instruments import InstrumentConstantContradiction
from ltsim.diagnosis.prior import MAX_P_OF_TEST_FINDINGS
from ltsim.diagnosis.schema import EquivalentEffect, Finding, FindingEvidence, ParameterEstimate
from ltsim.diagnosis.scopes import scope_with_names
from ltsim.diagnosis.sentences import percent_text
from ltsim.physics.effects import ORDINARY_CALIBRATION_EFFECTS, parameter_text
from ltsim.physics.effects.linear_effect import Parameter
from ltsim.recordings.recording import OBSERVABLES

DECLARED_COORDINATES_TEXT = "reference coordinates"
"""Name, shown to users, of the wrong quantity in a finding on a point: the declared coordinates that define the
axes."""


def blunder_finding(blunder: IdentifiedBlunder) -> Finding:
    """Finding that reports a blunder whose size the network determines."""
    return Finding(
        effect=blunder.effect_name,
        known=True,
        where=scope_with_names(observables=blunder.observables, stations=blunder.stations, targets=blunder.targets),
        parameters=(
            ParameterEstimate(
                name="size", value=1e3 * blunder.displacement, sigma=1e3 * blunder.displacement_sigma, unit="mm"
            ),
        ),
        evidence=FindingEvidence(
            chi2_drop=(blunder.displacement / blunder.displacement_sigma) ** 2,
            parameters=3,
            p_value=None,
            probability=MAX_P_OF_TEST_FINDINGS,
        ),
        sentence=blunder.sentence,
    )


def axes_point_finding(test: ReferenceTest) -> Finding:
    """Finding that reports a point whose declared coordinates contradict the axes that the other points define.

    `test` is the test of these coordinates.
    """
    estimates = [
        ParameterEstimate(name=f"off along {axis}", value=e / MILLIMETRE, sigma=s / MILLIMETRE, unit="mm")
        for axis, e, s in zip(test.declared_axes, test.error.tolist(), test.error_sigmas.tolist(), strict=True)
        if np.isfinite(s)
    ]
    return Finding(
        effect="unknown",
        known=False,
        where=scope_with_names(targets=(test.name,)),
        parameters=tuple(estimates),
        evidence=FindingEvidence(
            chi2_drop=test.chi2_drop, parameters=test.rank, p_value=None, probability=MAX_P_OF_TEST_FINDINGS
        ),
        sentence=test.sentence[0].upper() + test.sentence[1:] + ".",
        carrier=DECLARED_COORDINATES_TEXT,
    )


def contradicting_instrument_constant_finding(contradiction: InstrumentConstantContradiction) -> Finding:
    """Finding that reports an instrument constant that contradicts its reference.

    The reference is the other instruments, earlier calibrations, or a declared correction.
    """
    p, off = contradiction.parameter, 1.0 / (1.0 + float(np.exp(-contradiction.log_evidence)))
    p_by_effect_name: dict[str, float] = {}
    for constant, share in contradiction.evidence_share_by_constant.items():
        p_by_effect_name[_effect_name_of_constant(constant)] = (
            p_by_effect_name.get(_effect_name_of_constant(constant), 0.0) + off * share
        )
    estimate, (probability, rivals) = (
        ParameterEstimate.from_si(p, contradiction.difference_from_reference, contradiction.sigma),
        probability_and_equivalents(p_by_effect_name, _effect_name_of_constant(p)),
    )
    rival_names = " or ".join(
        parameter_text(other.name) for other in contradiction.evidence_share_by_constant if other != p
    )
    owners = " and ".join(filter(None, contradiction.instruments)) or "the instrument"
    ambiguity = (
        f" These readings hardly distinguish this instrument constant from {rival_names}." if rival_names else ""
    )
    sentence = (
        f"The {parameter_text(p.name)} of {owners} differs by "
        f"({with_sigma(estimate.value, estimate.sigma)}) {p.unit} from {contradiction.reference_text}, "
        f"with a probability of {percent_text(off)}.{ambiguity}"
    )
    chi2_drop = (contradiction.difference_from_reference / contradiction.sigma) ** 2
    return Finding(
        effect=_effect_name_of_constant(p),
        known=True,
        where=scope_with_names(instruments=tuple(filter(None, contradiction.instruments))),
        parameters=(estimate,),
        evidence=FindingEvidence(
            chi2_drop=chi2_drop, parameters=1, p_value=contradiction.p_value, probability=probability, p_same_scope=off
        ),
        sentence=sentence,
        equivalents=rivals,
    )


def _effect_name_of_constant(constant: Parameter) -> str:
    """Name of the effect of the ordinary calibration to which an instrument constant belongs."""
    return next(e.name for e in ORDINARY_CALIBRATION_EFFECTS if constant.name in {q.name for q in e.parameters})


EFFECT_NAME_BY_CAUSE = {
    ("constant-offset", "distance"): "reflector-constant",
    ("constant-offset", "elevation"): "vertical-index",
    ("constant-step", "distance"): "range-step",
    ("constant-step", "elevation"): "vertical-index",
    ("constant-drift", "distance"): "range-drift",
    ("constant-drift", "elevation"): "index-drift",
    ("constant-drift", "azimuth"): "azimuth-drift",
    ("scale-error", "distance"): "range-scale",
    ("orientation", "azimuth"): "station-bump",
    ("station-bump", "position"): "station-bump",
    ("station-drift", "position"): "station-settling",
    ("station-settling", "position"): "station-settling",
    ("target-moved", "position"): "target-moved",
    ("reflector-radius", "position"): "smr-offset",
    ("reflector-seating", "position"): "nest-lift",
    ("centring", "position"): "nest-lift",
    ("names", "position"): "target-swap",
    ("names", "point"): "target-swap",
    ("unit", "position"): "wrong-unit",
    ("height", "position"): "outlier",
}
"""Name of the catalogue effect in the report of a cause that a test identified, by the kind of the cause and the
quantity on which it acts. An outlier with another key is reported as `outlier`, and any other cause as `unknown`."""


def cause_test_finding(test: CauseTest) -> Finding:
    """Finding that reports the selected cause of a test of the adjustment, such as a moved target."""
    name = "outlier" if test.kind == "outlier" else EFFECT_NAME_BY_CAUSE.get((test.kind, test.acts_on), "unknown")
    observables = (test.acts_on,) if test.acts_on in OBSERVABLES else ()
    estimates: tuple[ParameterEstimate, ...] = ()
    if test.estimate is not None:
        estimates = (ParameterEstimate(name="size", value=test.estimate, sigma=test.sigma or 0.0, unit=test.unit),)
    wrong = test.kind == "reference-value"
    wrong_value = DECLARED_COORDINATES_TEXT if test.acts_on == "point" else f"reference {test.acts_on}"
    return Finding(
        effect=name,
        known=name != "unknown",
        where=scope_with_names(observables=observables, stations=test.where.stations, targets=test.where.targets),
        parameters=estimates,
        evidence=FindingEvidence(
            chi2_drop=test.statistic, parameters=test.dof, p_value=test.p_value, probability=test.probability or 1.0
        ),
        sentence=test.sentence,
        equivalents=tuple(
            EquivalentEffect(effect=EFFECT_NAME_BY_CAUSE.get((a.kind, "position"), a.kind), probability=a.probability)
            for a in test.alternatives
        ),
        carrier=wrong_value if wrong else "",
    )
