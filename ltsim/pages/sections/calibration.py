"""What a report says of a calibration or an adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ltsim.arrays import Floats
from ltsim.calibration.files import read_targets
from ltsim.calibration.schema import RESIDUALS, TARGETS, CalibrationFile
from ltsim.chances import p_text, two_sided
from ltsim.errors import ConvergenceError, NetworkError
from ltsim.pages import figures, style
from ltsim.pages.document import Block, Detail, Fact, Note, Section, Table, mood, picture
from ltsim.pages.residuals import Residuals
from ltsim.pages.sections.network import (
    combined,
    residual_blocks,
    station_table,
    target_table,
    undetermined,
    workshop_blocks,
)
from ltsim.pages.sections.recording import adjusted
from ltsim.pages.words import agreement, count
from ltsim.pages.workshop import Sights, Workshop, assemble
from ltsim.recording import Recording, Setup
from ltsim.recording.result_file import check_source, companion, read_result
from ltsim.units import MILLIMETRE

SETTLED = ("", "converged", "not stated")
"""How a fit may have ended that nobody need worry about."""


def calibration_section(
    folder: Path, recording: Recording | None = None, *, detail: Detail = "turn", brief: bool = False
) -> Section:
    """The section of a folder with `calibration.json`.

    A `recording` adds the floor plan and the residuals before; a `brief` section leaves residuals to the diagnosis.

    Raises
    ------
    RecordError
        When a file is malformed.
    """
    content = read_result(folder, CalibrationFile)
    check_source(content, recording, folder)
    agrees, words = agreement(content.fit.chi2, content.fit.dof, content.fit.p_value)
    words = (
        "the noise was estimated from the same readings, which leaves nothing to test"
        if content.noise_estimated
        else words
    )
    converged = content.fit.status in SETTLED
    blocks: list[Block] = []
    if not converged:
        blocks.append(Note("The adjustment did not converge", content.fit.sentence or content.fit.status, "bad"))
    blocks += _treatment(content)
    blocks += parameter_blocks(content)
    blocks += [Note("Estimated beside the calibration", f"{e.sentence}.") for e in content.effects]
    blocks += _criteria(content)
    blocks += _network(folder, content, recording, detail=detail, residuals=not brief)
    blocks += combined("Determined in combination", content.determined)
    told = "What the recording tells of the combination: 0 % is nothing beyond the maker's guarantee."
    blocks += undetermined("Not determined by this recording", content.undetermined, decimals=1, note=told)
    blocks += _known(content)
    blocks += _outliers(content)
    good = agrees and converged and all(outlier.left_out for outlier in content.outliers)
    title = (recording.setup.title if recording else "") or folder.name
    return Section(
        title,
        _kind(content),
        _answer(content, words),
        "good" if good else "bad",
        _facts(content, agrees=agrees),
        blocks,
    )


def _kind(content: CalibrationFile) -> str:
    """What the folder holds."""
    return f"Calibration ({content.method or 'network'})" if content.parameters else "Network adjustment"


def _answer(content: CalibrationFile, agreement_words: str) -> str:
    """The first sentence."""
    size = count(len(content.stations), "station")
    if not content.parameters:
        begin = f"The network of {size} was adjusted without instrument parameters: {agreement_words}"
    else:
        clear = [row for row in parameter_rows(content) if row.determined]
        begin = (
            f"The instrument was calibrated from {size}: {len(clear)} of "
            f"{count(len(content.parameters), 'parameter')} are determined, and {agreement_words}"
        )
    distance = content.criteria.get("distance")
    if distance is not None and distance.improvement_percent is not None:
        change = distance.improvement_percent
        word = "better" if change >= 0 else "worse"
        begin += (
            f"; stations agree about distances {abs(change):.1f} % {word} than before "
            f"({style.number(distance.before.mean_um)} to {style.number(distance.after.mean_um)} µm)"
        )
    if content.outliers:
        left = sum(outlier.left_out for outlier in content.outliers)
        begin += f"; {count(len(content.outliers), 'reading')} did not fit"
        were = "was" if left == 1 else "were"
        begin += f" and {were} left out" if left == len(content.outliers) else f", {left} left out" if left else ""
    return begin + "."


def _facts(content: CalibrationFile, *, agrees: bool) -> list[Fact]:
    """Figures at a glance."""
    fit, found = content.fit, content.noise_estimated
    p = None if found or fit.p_value is None else two_sided(fit.p_value)
    return [
        Fact("sigma0", style.fixed(fit.sigma0, 3), mood(agrees)),
        Fact("p of the fit, two-sided", p_text(p), "plain" if found else mood(agrees)),
        Fact("degrees of freedom", str(fit.dof)),
        Fact("construction", content.construction or "–"),
        Fact("outliers", str(len(content.outliers)), "bad" if content.outliers else "plain"),
        Fact("status", fit.status or "–", "good" if fit.status in SETTLED else "bad"),
    ]


def _treatment(content: CalibrationFile) -> list[Block]:
    """Which test to trust, the noise found, targets without a place."""
    blocks: list[Block] = []
    if content.verdict.sentence and not content.noise_estimated:
        blocks.append(Note("Which test to trust", content.verdict.sentence))
    if content.lost_targets:
        text = "What is left of their readings does not determine them: " + ", ".join(content.lost_targets) + "."
        blocks.append(Note("Targets without coordinates", text, "bad"))
    if content.noise:
        rows = [
            [
                n.observable,
                n.instrument or "–",
                "as stated" if n.factor_sigma is None else style.with_sigma(n.factor, n.factor_sigma),
                f"{style.number(n.typical)} {style.unit_text(n.unit)}",
                f"{n.redundancy:.1f}",
            ]
            for n in content.noise
        ]
        note = (
            "The factor is on the stated standard deviation, the reading's σ the median that results. 'As stated': too "
            "little redundancy to estimate it."
        )
        header = ["readings", "instrument", "factor ± σ", "σ of a reading", "redundancy"]
        blocks.append(Table("Noise found from the readings", header, rows, 2, note))
    return blocks


def parameter_rows(content: CalibrationFile) -> list[figures.ParameterRow]:
    """Rows for the figure."""
    return [
        figures.ParameterRow(
            f"{p.name} ({p.instrument})" if p.instrument else p.name, p.value, p.sigma or 0.0, p.unit, p.prior_sigma
        )
        for p in content.parameters
    ]


def parameter_blocks(content: CalibrationFile) -> list[Block]:
    """Table and figures of the parameters."""
    rows = parameter_rows(content)
    if not rows:
        return []
    cells = [
        [
            row.name,
            style.with_sigma(row.value, row.sigma),
            style.unit_text(row.unit) or "–",
            style.number(row.prior_sigma, 2) if row.prior_sigma else "–",
            f"{row.value / row.sigma:.1f}".replace("-", "−") if row.sigma > 0 else "–",
            "" if row.determined else "hardly",
        ]
        for row in rows
    ]
    blocks: list[Block] = [
        picture(
            "Instrument parameters",
            figures.parameters(rows),
            "Corrections (truth minus reading) with 95 % intervals, against the spread that the maker guarantees.",
        ),
        Table(
            "Instrument parameters",
            ["parameter", "value ± σ", "unit", "prior σ", "value / σ", "determined"],
            cells,
            note="A parameter is 'hardly' determined where the recording removes less than half of the prior variance.",
        ),
    ]
    if len(content.covariance) == len(rows) and len(rows) > 1:
        blocks.append(
            picture(
                "Correlation of the parameters",
                figures.correlation([row.name for row in rows], _correlation(np.array(content.covariance))),
                "Two parameters near ±100 % can hardly be told apart with this network.",
            )
        )
    return blocks


def _correlation(covariance: Floats) -> Floats:
    """Correlation coefficients; zero where a parameter is fixed."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    return np.asarray(covariance / np.outer(scale, scale))


def _criteria(content: CalibrationFile) -> list[Block]:
    """The paper's criteria before and after."""
    rows = []
    for name, entry in content.criteria.items():
        before, after = entry.before, entry.after
        sizes = [before.mean_um, after.mean_um, before.max_um, after.max_um]
        known = [size for size in sizes if size is not None]
        if len(known) == 4:
            label = name.replace("_", " ")
            rows.append(figures.Criterion(label, known[0], known[1], known[2], known[3], entry.improvement_percent))
    if not rows:
        return []
    text = "How far stations disagree about distances between reflectors and about their coordinates."
    return [picture("Criteria before and after calibration", figures.criteria(rows), text)]


def _network(
    folder: Path, content: CalibrationFile, recording: Recording | None, *, detail: Detail, residuals: bool
) -> list[Block]:
    """Residuals, floor plan, 3D view, stations and targets, as far as the files are there."""
    blocks: list[Block] = []
    before, geometry = residuals_before(None, recording)
    file = companion(folder, RESIDUALS.file, content)
    after = Residuals.read(file) if file else None
    if after is not None and geometry is not None:
        after = after.with_covariates(geometry)
    targets = companion(folder, TARGETS.file, content)
    if targets and content.stations:
        names, points, sigma = read_targets(targets)
        workshop = workshop_of(content, recording, names, points, sigma, after)
        blocks += workshop_blocks(workshop, detail=detail)
        position = np.array([s.position_mm for s in content.stations]) * MILLIMETRE
        spread = [[np.nan if v is None else v for v in s.sigma_position_mm or (None,) * 3] for s in content.stations]
        frame = f"Coordinates are in {content.frame or 'the frame of the first station'}."
        tables = [
            station_table(tuple(s.name for s in content.stations), position, np.array(spread) * MILLIMETRE, note=frame),
            target_table(names, points, sigma, note=frame),
        ]
    else:
        tables = []
    if after is not None and residuals:
        blocks += residual_blocks(after, before, what="the instrument's parameters")
    return blocks + tables


def residuals_before(stored: Path | None, recording: Recording | None) -> tuple[Residuals | None, Residuals | None]:
    """Residuals without parameters (from a `stored` table, else computed), and rows with covariates."""
    plain = None
    if recording is not None:
        try:
            plain = Residuals.from_adjustment(adjusted(recording)[0])
        except (NetworkError, ConvergenceError):
            plain = None
    if stored is None:
        return plain, plain
    before = Residuals.read(stored)
    return (before.with_covariates(plain) if plain else before), plain


def workshop_of(
    content: CalibrationFile,
    recording: Recording | None,
    names: tuple[str, ...],
    points: Floats,
    sigma: Floats,
    residuals: Residuals | None,
) -> Workshop:
    """The calibrated network, ready to be drawn."""
    stations = tuple(s.name for s in content.stations)
    return assemble(
        recording.setup if recording is not None else Setup(),
        title=(recording.setup.title if recording is not None else "") or "Calibrated network",
        stations=stations,
        position=np.array([s.position_mm for s in content.stations], dtype=np.float64) * MILLIMETRE,
        rotation=Rotation.from_quat([s.rotation_quaternion for s in content.stations]).as_matrix(),
        targets=names,
        points=points,
        sights=_sights(residuals, stations, names),
        covariance=np.einsum("ti,ij->tij", np.nan_to_num(sigma) ** 2, np.eye(3)),
    )


def _sights(residuals: Residuals | None, stations: Sequence[str], targets: Sequence[str]) -> Sights | None:
    """Lines of sight with the size of their normalised residuals."""
    if residuals is None:
        return None
    station_at = {name: i for i, name in enumerate(stations)}
    target_at = {name: i for i, name in enumerate(targets)}
    known = [
        i
        for i, (s, t) in enumerate(zip(residuals.station.tolist(), residuals.target.tolist(), strict=True))
        if s in station_at and t in target_at
    ]
    if not known:
        return None
    return Sights(
        np.array([station_at[residuals.station[i]] for i in known]),
        np.array([target_at[residuals.target[i]] for i in known]),
        np.abs(np.nan_to_num(residuals.w[known])),
        "largest normalised residual",
    )


def _known(content: CalibrationFile) -> list[Block]:
    """Known values, each tested by the rest."""
    if not content.known:
        return []
    rows = [
        [
            k.kind,
            k.name,
            k.component,
            f"{style.number(k.residual)} {style.unit_text(k.unit)}",
            style.number(k.error),
            "" if k.sigma_error is None else style.number(k.sigma_error),
            "" if k.minimal_detectable is None else style.number(k.minimal_detectable),
            f"{k.redundancy:.2f}",
            f"{k.w:.1f}",
            "yes" if k.left_out else "",
        ]
        for k in sorted(content.known, key=lambda k: (not k.left_out, -k.w))
    ]
    header = [
        "known",
        "name",
        "",
        "stated less adjusted",
        "error",
        "sigma",
        "detectable",
        "redundancy",
        "w",
        "left out",
    ]
    return [Table("Known values, each tested by the rest", header, rows, text_columns=3)]


def _outliers(content: CalibrationFile) -> list[Block]:
    """Readings that do not belong."""
    if not content.outliers:
        return []
    rows = [
        [
            o.station,
            o.target,
            o.observable,
            str(o.row),
            f"{style.number(o.size)} {style.unit_text(o.unit)}",
            f"{o.w:.1f}",
            "yes" if o.left_out else "",
        ]
        for o in content.outliers
    ]
    header = ["station", "target", "observable", "row", "size", "w", "left out"]
    return [Table("Readings that do not belong", header, rows, text_columns=3)]
