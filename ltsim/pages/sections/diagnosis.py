"""What a report says of a diagnosis: the sentence first, then what carries it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ltsim.calibration.files import read_targets
from ltsim.calibration.schema import RESIDUALS
from ltsim.chances import p_text, two_sided
from ltsim.diagnosis.schema import BEFORE, TARGETS, DiagnosisFile, Finding, Fit, Where
from ltsim.pages import figures, style
from ltsim.pages.document import Block, Fact, Note, Section, Table, mood, picture
from ltsim.pages.residuals import Residuals
from ltsim.pages.sections.calibration import residuals_before
from ltsim.pages.sections.network import combined, residual_blocks, target_table
from ltsim.pages.words import count, listing, typeset
from ltsim.recording import Recording
from ltsim.recording.recording import OBSERVABLES
from ltsim.recording.result_file import check_source, companion, read_result

LEAST_UM = 0.1
"""What an effect hides below this [um] is no matter."""


def diagnosis_section(folder: Path, recording: Recording | None = None) -> Section:
    """The section of a folder with `diagnosis.json`.

    Residuals without the findings are read from `residuals_before.csv`, those with them from `residuals.csv`.

    Raises
    ------
    RecordError
        When a file is malformed.
    """
    content = read_result(folder, DiagnosisFile)
    check_source(content, recording, folder)
    before, after = _residuals(folder, content, recording)
    blocks: list[Block] = []
    for number, finding in enumerate(content.findings, start=1):
        blocks += _finding(finding, number, before, after)
    blocks += _fit(content)
    if after is not None:
        blocks += residual_blocks(after, before, what="the findings")
    blocks += _instruments(content) + _limits(content) + _targets(folder, content)
    title = (recording.setup.title if recording else "") or folder.name
    return Section(title, "Diagnosis", typeset(content.summary), mood(_good(content)), _facts(content), blocks)


def _facts(content: DiagnosisFile) -> list[Fact]:
    """Figures at a glance."""
    test = content.global_test
    verdict = mood(_good(content))
    facts = [
        Fact("verdict", content.verdict, verdict),
        Fact("findings", str(len(content.findings)), verdict),
        Fact("global test, two-sided p", p_text(two_sided(test.p_value) if test.p_value and test.dof > 0 else None)),
    ]
    if test.search_p_value is not None:
        facts.append(Fact("whole search, p", p_text(test.search_p_value)))
    if content.fit is not None:
        before, after = content.fit.before, content.fit.after
        facts.append(Fact("χ² per d.o.f.", f"{_ratio(before)} → {_ratio(after)}"))
        if before.held_out_rms is not None and after.held_out_rms is not None:
            better = mood(after.held_out_rms <= before.held_out_rms)
            facts.append(Fact("held-out error", f"{before.held_out_rms:.3f} → {after.held_out_rms:.3f}", better))
    return facts


def _good(content: DiagnosisFile) -> bool:
    return content.verdict == "consistent"


def _ratio(fit: Fit) -> str:
    return f"{fit.chi2 / fit.dof:.3f}" if fit.dof > 0 and fit.chi2 is not None else "–"


def _residuals(
    folder: Path, content: DiagnosisFile, recording: Recording | None
) -> tuple[Residuals | None, Residuals | None]:
    """Residuals without and with the findings; covariates come from the recording's geometry."""
    file = companion(folder, RESIDUALS.file, content)
    if file is None:
        return None, None
    stored = companion(folder, BEFORE.file, content)
    before, geometry = residuals_before(stored, recording)
    after = Residuals.read(file)
    return (before if stored else None), (after.with_covariates(geometry) if geometry else after)


def _finding(finding: Finding, number: int, before: Residuals | None, after: Residuals | None) -> list[Block]:
    """One finding: sentence, parameters, rivals, signature."""
    name = finding.effect if finding.known else "an effect that no catalogue entry explains"
    words = typeset(finding.sentence) or f"{name} {_place(finding.where)}"
    cure = f" To tell it from the others: {finding.separate_by.rstrip('.')}." if finding.separate_by else ""
    new = finding.formula not in finding.sentence
    formula = f" Proposed term: {typeset(finding.formula)}." if finding.formula and new else ""
    blocks: list[Block] = [Note(f"Finding {number}: {name}", f"{words.rstrip('.')}.{formula}{cure}", "bad")]
    rows = [[p.name, style.with_unit(p.value, p.sigma, p.unit)] for p in finding.parameters]
    rows.append(["where", _place(finding.where)])
    evidence = finding.evidence
    rows.append(["χ² falls by", f"{style.number(evidence.chi2_drop)} for {count(evidence.parameters, 'parameter')}"])
    rows.append(["p, corrected for the search", p_text(evidence.p_value)])
    blocks.append(Table(f"Finding {number} in figures", ["", "value"], rows, text_columns=2))
    rivals = [
        figures.Candidate(finding.effect, evidence.probability, evidence.chi2_drop, evidence.parameters, "finding"),
        *(figures.Candidate(e.effect, e.probability) for e in finding.equivalents),
    ]
    text = "How probable each explanation is after the data, among those that were tried."
    blocks.append(picture(f"Evidence for finding {number}", figures.evidence(rivals), text))
    return blocks + _curve(finding, number, before) + _signature(finding, number, before, after)


def _curve(finding: Finding, number: int, before: Residuals | None) -> list[Block]:
    """What a carrier does over its driver, where a finding has a curve."""
    curve = finding.curve
    if curve is None or len(curve.at) < MOST_STEPS:
        return []
    columns = (np.array(values) for values in (curve.at, curve.value, curve.sigma))
    figure = figures.driver_curve(
        *columns, covariate=curve.covariate, carrier=finding.carrier, unit=curve.unit, residuals=before
    )
    text = f"What fits: the {finding.carrier} over {curve.covariate}, with its 95 % band."
    if before is not None and finding.carrier in OBSERVABLES and curve.covariate in before.covariates:
        text += " Dots: residuals without the finding."
    return [picture(f"Curve of finding {number}", figure, text)]


MOST_STEPS = 3
"""Points from which a curve is drawn."""


def _instruments(content: DiagnosisFile) -> list[Block]:
    """Constants of each instrument, and the combinations of them that the recording determines."""
    blocks: list[Block] = []
    for entry in content.instruments:
        name = f" of {entry.name}" if entry.name else ""
        rows = [[p.name, style.with_unit(p.value, p.sigma, p.unit)] for p in entry.parameters]
        title = f"Constants{name}, with the findings modelled"
        blocks.append(Table(title, ["constant", "value"], rows, text_columns=2))
        blocks += combined(f"What the recording determines{name} in combination", entry.determined)
    return blocks


def _signature(finding: Finding, number: int, before: Residuals | None, after: Residuals | None) -> list[Block]:
    """Residuals against the finding's first covariate, without and with it."""
    if before is None or after is None:
        return []
    wanted = [*finding.where.covariates, "time", "elevation", "row"]
    known = [name for name in wanted if name in before.covariates and name in after.covariates]
    place = finding.where.stations, finding.where.targets
    if not known or not before.at(*place).any() or not after.at(*place).any():  # gross errors leave no residual
        return []
    figure = figures.signature(
        before,
        after,
        covariate=known[0],
        observables=finding.where.observables,
        stations=place[0],
        targets=place[1],
    )
    text = "Residuals without the finding (left) and with it modelled (right); the band is the running mean ± 2 s.e."
    return [picture(f"Signature of finding {number}", figure, text)]


def _place(where: Where) -> str:
    """Where a finding acts, in words."""
    parts = [
        f"{word} {listing(list(names))}"
        for word, names in (
            ("in", where.observables),
            ("of instrument", where.instruments),
            ("at station", where.stations),
            ("at target", where.targets),
            ("along", where.covariates),
        )
        if names
    ]
    return ", ".join(parts) or "everywhere"


def _fit(content: DiagnosisFile) -> list[Block]:
    """Fit before and after."""
    if content.fit is None:
        return []
    rows = []
    for word, fit in (("without the findings", content.fit.before), ("with the findings", content.fit.after)):
        rows.append([word, style.fixed(fit.chi2, 1), str(fit.dof), _ratio(fit), style.fixed(fit.held_out_rms, 3)])
    note = "Held-out error: normalised error of readings that the fit did not see; 1 is what the stated noise explains."
    header = ["", "χ²", "degrees of freedom", "ratio", "held-out error"]
    return [Table("Fit before and after", header, rows, note=note)]


def _limits(content: DiagnosisFile) -> list[Block]:
    """What could not be seen at all, and how small the rest may be."""
    blocks: list[Block] = []
    if content.undetectable:
        rows = [[u.effect, u.reason, u.cure, _hidden(u.hides_um)] for u in content.undetectable]
        header = ["effect", "why it leaves no residual", "what would show it", "may hide"]
        blocks.append(Table("What this network cannot see", header, rows, text_columns=3))
    if content.detectable:
        rows = [
            [d.effect, d.parameter, "–" if d.size is None else f"{style.number(d.size, 2)} {style.unit_text(d.unit)}"]
            for d in content.detectable
        ]
        note = (
            "About 80 % of recordings of this network are told as a mismatch if an effect at a middling place is this "
            "large; to be named it may have to be larger."
        )
        blocks.append(Table("Smallest size that is found", ["effect", "parameter", "size"], rows, 2, note))
    return blocks


def _targets(folder: Path, content: DiagnosisFile) -> list[Block]:
    """Coordinates with the findings modelled."""
    file = companion(folder, TARGETS.file, content)
    if file is None:
        return []
    names, points, sigma = read_targets(file)
    return [target_table(names, points, sigma, note="Adjusted with the findings modelled.")]


def _hidden(size: float | None) -> str:
    """How far an effect may move targets unseen [um]."""
    if size is None:
        return "–"
    return f"{style.number(size, 2)} µm" if size >= LEAST_UM else f"under {LEAST_UM:g} µm"
