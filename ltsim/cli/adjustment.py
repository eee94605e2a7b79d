"""`ltsim adjust`, `calibrate`, `correct`, `evaluate`, `verify`: what a recording says of network and instrument."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import ltsim as lt
from ltsim.chances import AGREES, p_is, two_sided
from ltsim.cli.options import CalibrationFile, FramedReading, OptionalCalibrationFile, Out, Reading, Source
from ltsim.cli.places import Force, claim, claim_recording
from ltsim.cli.terminal import Terminal
from ltsim.notation import aligned, number, with_sigma
from ltsim.units import ARCSECOND, MICROMETRE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ltsim.calibration import Calibration
    from ltsim.calibration.schema import KnownEntry
    from ltsim.evaluation import Criteria
    from ltsim.recording import Recording

Corrected = Annotated[Path, typer.Option("--out", metavar="REC2", help="Folder of the corrected recording.")]
Nominal = Annotated[
    Path, typer.Option("--nominal", metavar="FILE", help="Points of the targets: target,x_mm,y_mm,z_mm.")
]
METHODS = {
    "adjustment": "network adjustment without instrument parameters",
    "network": "network adjustment",
    "distance": "distances, least squares (the paper's), over what the readings determine",
    "distance-l1": "distances, least absolute deviations (the paper's), over what the readings determine",
    "equation-9": "distances, the minimum of the paper's eq. 9, least squares",
    "equation-9-l1": "distances, the minimum of the paper's eq. 9, least absolute deviations",
}
MOST_SHOWN = 12
MOST_KNOWN = 12
CONSPICUOUS = 3.0
"""w from which a level is shown among the known values."""


def adjust(
    source: Source,
    *,
    out: Out = None,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
    **options: Any,
) -> None:
    """Adjust the network of a recording without instrument parameters: targets, stations, outliers.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim adjust my-recording --robust --noise-from-data --out adjusted
    """
    claim_results(out, adjusted=True, force=force)
    recording = reading.open(source, terminal)
    with terminal.busy("adjusting"):
        found = lt.adjust(recording, **options)
    finish(terminal, found, out)


def calibrate(
    source: Source,
    *,
    out: Out = None,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
    **options: Any,
) -> None:
    """Find the instrument's parameters from a recording, with uncertainty, and say what it cannot tell.

    Writes calibration.json, targets.csv and residuals.csv to --out.

    Example: ltsim calibrate my-recording --out my-calibration
    """
    claim_results(out, adjusted=False, force=force)
    recording = reading.open(source, terminal)
    with terminal.busy("calibrating"):
        found = lt.calibrate(recording, **options)
    finish(terminal, found, out)


def correct(
    source: Source,
    calibration: CalibrationFile,
    out: Corrected,
    *,
    reading: FramedReading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Write the recording that an ideal tracker would have made, by a calibration of the instrument.

    Readings stay in the axes of each set-up; with --frame whatever is computed from them later is in those of FILE.

    Example: ltsim correct my-recording --calibration my-calibration --out corrected
    """
    import numpy as np

    from ltsim.geometry.polar import wrap

    claim_recording(out, force=force)
    recording = reading.of(source)
    terminal.notes(recording.notes)
    found = calibration_of(terminal, calibration)
    if not found.names:
        terminal.notes(["this calibration holds no instrument parameters; nothing changes"])
    if found.effects:
        beside = ", ".join(effect.effect for effect in found.effects)
        terminal.notes([f"estimated beside the calibration and not taken out of the readings: {beside}"])
    corrected = lt.correct(recording, found, again=force)
    lt.write(corrected, out)
    change = corrected.readings - recording.readings
    change[:, 1:] = wrap(change[:, 1:])
    largest = np.nanmax(np.abs(change), axis=0, initial=0.0) / [MICROMETRE, ARCSECOND, ARCSECOND]
    keys = ("distance_um", "azimuth_arcsec", "elevation_arcsec")
    terminal.answer({"pointings": len(recording), "largest_change": dict(zip(keys, largest.tolist(), strict=True))})
    terminal.say(
        f"{len(recording)} pointings corrected by up to {largest[0]:.1f} um in distance, "
        f"{largest[1]:.2f} arcsec in azimuth, {largest[2]:.2f} arcsec in elevation"
    )
    terminal.say(f"written to {out}")


def evaluate(
    source: Source,
    calibration: OptionalCalibrationFile = None,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """How far the stations disagree about distances and coordinates, before and after a calibration.

    Writes criteria.json to --out. Without a calibration there is no "after".

    Example: ltsim evaluate my-recording --calibration my-calibration
    """
    from ltsim.adjustment.snooping import screened
    from ltsim.evaluation.criteria import CriteriaFile

    claim(out, CriteriaFile, force=force)
    recording = reading.open(source, terminal)
    gross = screened(recording).gross
    if gross.any():
        rows = ", ".join(str(i + 1) for i in gross.nonzero()[0][:12])
        terminal.notes([f"{gross.sum()} pointings miss their target by far and are left out (rows {rows})"])
    found = None if calibration is None else calibration_of(terminal, calibration)
    show_criteria(terminal, lt.evaluate(recording, found), recording, out)


def verify(
    source: Source,
    nominal: Nominal,
    calibration: CalibrationFile,
    out: Out = None,
    *,
    reading: Reading,
    force: Force = False,
    terminal: Terminal,
) -> None:
    """Apply a calibration to another recording and compare with nominal points, before and after (eq. 13, 14).

    Writes criteria.json to --out.

    Example: ltsim verify laboratory --nominal cmm.csv --calibration my-calibration
    """
    from ltsim.evaluation.criteria import CriteriaFile

    claim(out, CriteriaFile, force=force)
    recording = reading.open(source, terminal)
    found = calibration_of(terminal, calibration)
    show_criteria(terminal, lt.verify(recording, nominal, found), recording, out)


def claim_results(out: Path | None, *, adjusted: bool, force: bool) -> None:
    """Make sure that a calibration, or a network `adjusted` without parameters, replaces nothing else."""
    from ltsim.calibration.schema import RESIDUALS, TARGETS, CalibrationFile

    names = (TARGETS.file, RESIDUALS.file)
    claim(out, CalibrationFile, names, force=force, own=lambda found: (found.method == "adjustment") == adjusted)


def finish(terminal: Terminal, calibration: Calibration, out: Path | None) -> None:
    """Write, then show."""
    from ltsim.calibration.files import calibration_file, write_calibration

    content = calibration_file(calibration) if out is None else write_calibration(calibration, out)
    terminal.answer(content.content())
    show_calibration(terminal, calibration)
    terminal.notes(calibration.notes)
    terminal.written(out)


def show_criteria(terminal: Terminal, criteria: Criteria, recording: Recording, out: Path | None) -> None:
    """Write and print criteria."""
    from ltsim.evaluation.criteria import CriteriaFile
    from ltsim.recording.result_file import SourceEntry, write_result

    content = CriteriaFile.model_validate({"recording": SourceEntry.of(recording), **criteria.as_json()})
    if out is not None:
        write_result(out, content, {})
    terminal.answer(content.content())
    terminal.say(criteria.table().text())
    if out is not None:
        terminal.say(f"\nwritten to {out}")


def calibration_of(terminal: Terminal, path: Path) -> Calibration:
    """A calibration that was written before, with what it lacks said; raises RecordError."""
    from ltsim.calibration import read_calibration

    found = read_calibration(path)
    terminal.notes(found.notes)
    return found


def show_calibration(terminal: Terminal, calibration: Calibration) -> None:
    """Fit, parameters, what was not determined, outliers, criteria."""
    fit = calibration.fit
    terminal.say(f"{METHODS[calibration.method]}, {fit_line(calibration)}")
    show_treatment(terminal, calibration)
    terminal.say(f"coordinates in {calibration.frame}")
    if calibration.names:
        terminal.say()
        terminal.say(parameter_table(calibration))
    for effect in calibration.effects:
        terminal.say(effect.sentence)
    if calibration.correction is not None and calibration.correction.uncorrected_um > 0:
        terminal.say("\n".join([calibration.correction.line, *calibration.correction.sentences]))
    if calibration.determined:
        terminal.say()
        terminal.say("known together far better than each alone:")
        for c in calibration.determined:
            at = f" of {c.instrument}" if c.instrument else ""
            terminal.say(f"  {c.terms}{at} = {with_sigma(c.value, c.sigma, c.unit)}")
    if calibration.undetermined:
        terminal.say()
        show_undetermined(terminal, calibration)
    if calibration.known:
        terminal.say()
        show_known(terminal, calibration.known)
    if calibration.outliers:
        terminal.say()
        show_outliers(terminal, calibration)
    if calibration.criteria is not None:
        terminal.say()
        terminal.say(calibration.criteria.table().text())
    if not math.isfinite(fit.chi2):
        terminal.say("the fit is not finite")


def fit_line(calibration: Calibration) -> str:
    """chi2/dof and what it says, and how the iteration ended."""
    fit = calibration.fit
    ended = f"{fit.status} after {fit.iterations} iterations ({fit.sentence})"
    if fit.sigma0 is None or fit.p_value is None:
        return f"construction {calibration.construction.name}: {ended}; no redundancy to test it with"
    p = two_sided(fit.p_value)
    agrees = p >= AGREES
    verdict = f"readings, model and stated noise {'agree' if agrees else 'do not agree'}"
    if not agrees and fit.p_value > 0.5:
        verdict = "the readings scatter less than the stated noise says"
    if calibration.noise_estimated:
        verdict = "no test, the noise was estimated from the same readings"
    return (
        f"construction {calibration.construction.name}: {ended}\n"
        f"chi2/dof = {fit.chi2:.1f}/{fit.dof} = {fit.chi2 / fit.dof:.3f}, two-sided {p_is(p)}: {verdict}"
    )


def show_treatment(terminal: Terminal, calibration: Calibration) -> None:
    """Which test to trust, the noise found, how much was left out, and what would be left out or found on request."""
    judged = calibration.verdict
    if judged is not None and not calibration.noise_estimated:
        terminal.say(judged.sentence)
        if judged.by_estimate and not calibration.noise:
            terminal.say("--noise-from-data would estimate the noise of each observable and instrument")
        if judged.outliers and not calibration.robust:
            terminal.say("--robust would leave out the readings that do not belong")
    if calibration.noise:
        terminal.say("noise found from the readings (factor on the stated one; median sigma of a reading):")
        terminal.say(calibration.table("noise").text())
    if calibration.robust:
        left = sum(outlier.left_out for outlier in calibration.outliers)
        terminal.say(f"robust: {left} of the readings left out" if left else "robust: no reading had to be left out")
    if calibration.lost_targets:
        lost = ", ".join(calibration.lost_targets[:MOST_SHOWN])
        terminal.say(f"without coordinates, what is left of their readings does not determine them: {lost}")


def parameter_table(calibration: Calibration) -> str:
    """Parameters that the data say something about; the others are counted."""
    from ltsim.calibration.calibration import PARAMETERS

    shown = [i for i in range(len(calibration.names)) if _informed(calibration, i)]
    text = PARAMETERS.filled(calibration.parameters[i] for i in shown).text()
    held = [i for i, is_held in enumerate(calibration.held.ravel().tolist()) if is_held]
    silent = len(calibration.names) - len(shown) - len(held)
    if silent:
        text += f"\n({silent} more parameters keep their prior)"
    return text + held_line(calibration, held)


def held_line(calibration: Calibration, held: list[int]) -> str:
    """Which parameters were held and where, those at zero counted if they are many."""
    if not held:
        return ""
    parameters = calibration.construction.parameters * len(calibration.instruments)
    values = {i: float(calibration.values.ravel()[i]) / parameters[i].factor for i in held}
    some = [f"{calibration.names[i]} = {value:g} {parameters[i].unit}" for i, value in values.items() if value]
    zero = [calibration.names[i] for i, value in values.items() if not value]
    if zero:
        some.append(f"{', '.join(zero) if len(zero) <= MOST_SHOWN else f'{len(zero)} parameters'} = 0")
    return f"\nheld, not estimated: {'; '.join(some)}"


def _informed(calibration: Calibration, i: int) -> bool:
    """Whether the prior variance of a parameter fell by 5 % at least."""
    from ltsim.calibration.calibration import SHARPER

    return float(calibration.sigma.ravel()[i]) < SHARPER * float(calibration.prior_sigma.ravel()[i])


def show_undetermined(terminal: Terminal, calibration: Calibration) -> None:
    """Combinations with their gain and cure; a long list is cut."""
    count = len(calibration.undetermined)
    terminal.say(f"not determined by this recording ({count}; coefficients in units of the prior sigmas):")
    # What the recording almost determines is of more use than what nothing would.
    listed = sorted(calibration.undetermined, key=lambda c: -(c.gain or 0.0))[:MOST_SHOWN]
    for combination in listed:
        terminal.say(f"  gain {combination.gain or 0.0:.2f}: {combination.terms}")
        if combination.cure:
            terminal.say(f"    cure: {combination.cure}")
    if count > MOST_SHOWN:
        terminal.say(f"  and {count - MOST_SHOWN} with less gain, in calibration.json")


def show_outliers(terminal: Terminal, calibration: Calibration) -> None:
    """Readings that do not belong, or that the stated noise does not explain where another is to be trusted."""
    judged = calibration.verdict
    by_estimate = judged is not None and judged.by_estimate and not calibration.noise_estimated
    what = "readings beyond the stated noise" if by_estimate else "readings that do not belong"
    terminal.say(f"{what} ({len(calibration.outliers)}):")
    recording = calibration.adjustment.recording if calibration.adjustment is not None else None
    for outlier in calibration.outliers[:MOST_SHOWN]:
        where = f"row {outlier.row}" if recording is None else recording.where(outlier.row)
        left = ", left out of the adjustment" if outlier.left_out else ""
        terminal.say(
            f"  {where}: {outlier.station} to {outlier.target}, {outlier.observable} off by "
            f"{float(f'{outlier.size:.3g}'):g} {outlier.unit} (w = {outlier.w:.1f}){left}"
        )
    if len(calibration.outliers) > MOST_SHOWN:
        terminal.say(f"  and {len(calibration.outliers) - MOST_SHOWN} more")


def show_known(terminal: Terminal, known: Sequence[KnownEntry]) -> None:
    """Known values by their tests, the worst first: how far each is from what the rest says."""
    told = [e for e in known if (e.sigma_error and e.kind not in ("level", "mark")) or e.left_out or e.w > CONSPICUOUS]
    if not told:
        return
    worst = sorted(told, key=lambda entry: (not entry.left_out, -entry.w))
    rows = [
        [
            f"{entry.kind} {entry.name} {entry.component}".rstrip(),
            number(entry.residual),
            with_sigma(entry.error if entry.sigma_error else None, entry.sigma_error),
            entry.unit,
            number(entry.redundancy, 2),
            number(entry.w, 2),
            "left out" if entry.left_out else "",
        ]
        for entry in worst[:MOST_KNOWN]
    ]
    terminal.say("known values (stated less adjusted; error by what the rest says):")
    terminal.say(aligned(["known", "residual", "error", "unit", "redundancy", "w", ""], rows))
    if len(known) > len(rows):
        terminal.say(f"  and {len(known) - len(rows)} more in calibration.json")
