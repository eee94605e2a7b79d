"""Causes that are too large to be compared in first order: they are in the model before anything is searched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import Selection, Test, outcomes
from ltsim.adjustment.identification.hypothesis import Hypothesis, NoiseFactor, Omission, Shift
from ltsim.adjustment.identification.selection import WRONG_PLACE
from ltsim.adjustment.snooping import LARGEST_ERROR
from ltsim.core.arrays import Bools
from ltsim.diagnosis.findings import place_of
from ltsim.diagnosis.schema import Equivalent, Estimate, Evidence, Finding
from ltsim.physics.model.construction import Construction
from ltsim.recordings.recording import OBSERVABLES, Recording

EFFECTS = {
    ("constant-offset", "distance"): "range-offset",
    ("constant-offset", "elevation"): "vertical-index",
    ("scale-error", "distance"): "range-scale",
    ("orientation", "azimuth"): "station-bump",
    ("station-bump", "position"): "station-bump",
    ("station-drift", "position"): "station-settling",
    ("target-moved", "position"): "target-moved",
    ("reflector-radius", "position"): "smr-offset",
    ("names", "position"): "target-swap",
    ("unit", "position"): "wrong-unit",
    ("height", "position"): "outlier",
}
"""Catalogue effect of a cause, by its kind and what it acts on; `outlier` and `unknown` for the others."""


def gross_causes(selection: Selection | None) -> list[Hypothesis]:
    """Shifts beyond any error of a tracker, reference values that are far off, and with these all that was chosen."""
    if selection is None or not selection.leads:
        return []
    fit, chosen = selection.fit, [c.hypothesis for c in selection.choices]
    limits = {Shift: LARGEST_ERROR, Omission: WRONG_PLACE}
    large = any(fit.displacement(h) > limits[type(h.change)] for h in chosen if type(h.change) in limits)
    return [h for h in chosen if not isinstance(h.change, NoiseFactor)] if large else []


def adapted(
    recording: Recording, construction: Construction, selection: Selection, causes: Sequence[Hypothesis]
) -> tuple[Adjustment, Bools, list[Finding]]:
    """The adjustment with causes in its model, readings (n, 3) to use, and the findings.

    The recording of the adjustment is corrected by the estimates; what these are uncertain by is estimated in it.
    """
    fit = selection.fit
    corrected = fit.corrected(recording)
    clean = recording.replace(
        readings=corrected.readings, target=corrected.target, face=corrected.face, setup=corrected.setup
    )
    start = replace(fit.state, extra=np.zeros(sum(len(e.parameters) for e in fit.effects)))
    use = ~fit.outliers
    baseline = adjust(clean, construction, effects=fit.effects, sigma=clean.sigma(), use=use, start=start)
    places = {(h.kind, h.stations, h.targets) for h in causes}
    tests = [
        t for t in outcomes(selection) if t.kind == "outlier" or (t.kind, t.where.stations, t.where.targets) in places
    ]
    return baseline, use, [finding_of(test) for test in tests]


def finding_of(test: Test) -> Finding:
    """The finding of a test that was accepted."""
    name = "outlier" if test.kind == "outlier" else EFFECTS.get((test.kind, test.acts_on), "unknown")
    observables = (test.acts_on,) if test.acts_on in OBSERVABLES else ()
    rows: tuple[Estimate, ...] = ()
    if test.estimate is not None:
        rows = (Estimate(name="size", value=test.estimate, sigma=test.sigma or 0.0, unit=test.unit),)
    formula = f"the {test.acts_on} of {', '.join((*test.where.stations, *test.where.targets))} is wrong"
    wrong = test.kind == "reference-value"
    return Finding(
        effect=name,
        known=name != "unknown",
        where=place_of(observables=observables, stations=test.where.stations, targets=test.where.targets),
        parameters=rows,
        evidence=Evidence(
            chi2_drop=test.statistic, parameters=test.dof, p_value=test.p_value, probability=test.probability or 1.0
        ),
        sentence=test.sentence,
        equivalents=tuple(
            Equivalent(effect=EFFECTS.get((a.kind, "position"), a.kind), probability=a.probability)
            for a in test.alternatives
        ),
        formula=formula if wrong else "",
        carrier=f"reference {test.acts_on}" if wrong else "",
    )
