"""Section of a recording, and blocks that several sections share: residuals, floor plan, 3D view, targets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ltsim.adjustment import Adjustment, adjust
from ltsim.adjustment.identification import identify_causes
from ltsim.adjustment.identification.recommendations import corrected_faults
from ltsim.calibration.combinations import UNDETERMINED_TABLE, DeterminedEntry, UndeterminedEntry
from ltsim.calibration.files import read_targets
from ltsim.calibration.identified_network import IdentifiedNetwork
from ltsim.calibration.schema import STATION_COORDINATES_TABLE
from ltsim.core.arrays import Floats
from ltsim.core.errors import ConvergenceError, NetworkError, is_installed, missing_extra_error
from ltsim.core.limits import MAX_NETWORK_SETUPS
from ltsim.core.notation import MISSING_TEXT, names_text, number_text
from ltsim.core.probability import p_value_text, two_sided_p_value
from ltsim.core.results import Table, number_columns, text_columns
from ltsim.physics.model.construction import declared_construction, ideal_construction
from ltsim.recordings import Recording, read
from ltsim.recordings.files import read_text
from ltsim.reports import figures
from ltsim.reports.document_model import (
    Block,
    CodeBlock,
    HallView,
    KeyFigure,
    NoteBlock,
    PictureBlock,
    SceneBlock,
    Section,
    SectionContext,
    TableBlock,
    assessment_of,
    entries_table_blocks,
    picture_if_few_items,
    table_blocks,
)  # fmt: skip
from ltsim.reports.formatting import count_text, duration_text, global_test_verdict, natural_sort_key
from ltsim.reports.residuals import DEFAULT_COVARIATES, Residuals
from ltsim.simulation.truth import Truth, read_truth

if TYPE_CHECKING:
    from ltsim.reports.workshop_scene import WorkshopScene

TRUTH_FILE_NAME = "truth.json"
"""Name of the file with the true values of a simulation."""
STATION_WORK_TABLE = Table(
    "work.csv",
    "work of each station",
    (
        *text_columns(station="name"),
        *number_columns(pointings="number", targets="number", faces="number", missing_readings="number"),
        *text_columns(starts_at="time since the first pointing"),
    ),
)
"""Columns of the table of the work of each station."""
AdjustmentsWithoutAndWithParameters = tuple[Adjustment, Adjustment]
"""Adjustments of the same recording: first without, then with the instrument's parameters."""


def networks_without_and_with_parameters(recording: Recording) -> tuple[IdentifiedNetwork, IdentifiedNetwork]:
    """Adjustments without and with the instrument's parameters, with the identified causes of a misfit in their models.

    Raises NetworkError, ConvergenceError.
    """
    selection = identify_causes(recording)
    without_parameters, with_parameters = (
        IdentifiedNetwork.from_cause_selection(recording, construction, selection)
        for construction in (ideal_construction(), declared_construction(recording))
    )
    return without_parameters, with_parameters


def adjustments_without_and_with_parameters(recording: Recording | None) -> AdjustmentsWithoutAndWithParameters | None:
    """Adjustments without and with the instrument's parameters; None without a recording that can be adjusted.

    The models contain the identified causes of a misfit only if the network cannot be adjusted without them.
    """
    if recording is None:
        return None
    try:
        pair = adjust(recording), adjust(recording, declared_construction(recording))
        if all(adjustment.solution.has_converged for adjustment in pair):
            return pair
    except NetworkError:
        pass
    try:
        without_parameters, with_parameters = networks_without_and_with_parameters(recording)
    except (NetworkError, ConvergenceError):
        return None
    return without_parameters.adjustment, with_parameters.adjustment


def truth_in_folder(context: SectionContext) -> Truth | None:
    """True values of a simulation, from the folder of a result; None without a file `truth.json`."""
    file = context.folder / TRUTH_FILE_NAME if context.folder else None
    return read_truth(file) if file is not None and file.is_file() else None


def residual_figures(residuals: Residuals, reference: Residuals | None) -> list[Block]:
    """Figures of residuals by station and over covariates.

    `reference` are residuals of the adjustment without the instrument's parameters, for comparison.
    """
    comparison_text = (
        " Grey: adjusted without the instrument's parameters; blue: with them." if reference is not None else ""
    )
    text = "Observed minus adjusted reading of every pointing; the bar is the root mean square."
    picture = PictureBlock(
        "Residuals by station",
        lambda: figures.residuals.residuals_by_station_figure(residuals, reference),
        text + comparison_text,
    )
    return [picture, *residuals_over_covariates(residuals)]


def residuals_over_covariates(residuals: Residuals) -> list[Block]:
    """List with the figure of residuals over covariates; empty without covariates."""
    text = "Lines: running means with twice their standard error; they stay at zero if the model is correct."
    title = "Residuals over covariates"
    shared = set(DEFAULT_COVARIATES) & set(residuals.covariates)
    return (
        [PictureBlock(title, lambda: figures.residuals.residuals_by_covariate_figure(residuals), text)]
        if shared
        else []
    )


def workshop_blocks(make_scene: Callable[[], WorkshopScene], hall_view: HallView) -> list[Block]:
    """Blocks with the view of a hall: floor plan for `floor-plan`, 3D view and floor plan for `3d`; empty for `none`.

    `make_scene` returns the scene of the hall.
    """
    if hall_view == "none":
        return []
    workshop = make_scene()
    text = (
        "Seen from above. Do not place a reflector on the floor inside a shadow circle: the elevation limit of the "
        "station hides it"
    )
    caption = "; ".join([text, *workshop.notes]) + "."
    plan = picture_if_few_items(
        "Floor plan", lambda: figures.floor_plan.floor_plan(workshop), caption, len(workshop.stations)
    )
    return [scene_block(workshop), plan] if hall_view == "3d" else [plan]


def scene_block(workshop: WorkshopScene) -> SceneBlock | NoteBlock:
    """3D view of a hall with its interactive page.

    The result is a note if the packages for 3D views are missing, or if there are more than `MAX_NETWORK_SETUPS`
    stations, because stations are drawn one by one.
    """
    if len(workshop.stations) > MAX_NETWORK_SETUPS:
        n_stations = len(workshop.stations)
        return NoteBlock(
            "No 3D view", f"{n_stations} stations are too many to draw; the limit is {MAX_NETWORK_SETUPS}."
        )
    if not is_installed("pyvista"):
        return NoteBlock("No 3D view", str(missing_extra_error("3D views", "view")))
    from ltsim.reports.scene_page import scene_picture_and_page  # slow to import
    from ltsim.reports.style import webp_data_uri

    coloured_workshop = workshop.with_sights_coloured_by("incidence")
    picture, legend, page = scene_picture_and_page(coloured_workshop)
    legend_text = "; ".join(line.rstrip(".") for line in legend.lines)
    colour_sentence = (
        f" Lines of sight are coloured by {coloured_workshop.sights.colour_label}." if coloured_workshop.sights else ""
    )
    caption = f"{legend_text[:1].upper()}{legend_text[1:]}.{colour_sentence}"
    return SceneBlock("The hall in 3D", webp_data_uri(picture), caption, page)


def undetermined_combination_tables(
    title: str, undetermined_entries: Sequence[UndeterminedEntry], *, note: str = ""
) -> list[TableBlock]:
    """Table of undetermined combinations of parameters, with the measurement that determines each of them.

    `title` is the title of the table, and `note` a text below it.
    """
    table_rows = [
        [entry.text, entry.cure, None if entry.gain is None else 100 * entry.gain] for entry in undetermined_entries
    ]
    return table_blocks(title, UNDETERMINED_TABLE.with_rows(table_rows), note=note)


def determined_combination_tables(title: str, determined_entries: Sequence[DeterminedEntry]) -> list[TableBlock]:
    """Table of combinations of parameters that are determined far better than the single parameters."""
    note = "The combination is determined far better than its single parameters."
    return entries_table_blocks(
        title, determined_entries, "text=combination", "instrument", "value+-sigma", "unit", note=note
    )


def target_tables(file: Path | None, *, note: str) -> list[TableBlock]:
    """List with the table of coordinates in a `targets.csv`, with expanded uncertainties; empty without a file.

    `note` is a text below the table.
    """
    if file is None:
        return []
    names, points, sigma = read_targets(file)
    order = sorted(range(len(names)), key=lambda i: natural_sort_key(names[i]))
    entries = [(names[i], (1e3 * points[i]).tolist(), (1e3 * sigma[i]).tolist()) for i in order]
    return coordinates_tables("Targets", entries, note=note, is_foldable=False)


def coordinates_tables(
    title: str,
    entries: Sequence[tuple[str, Sequence[float | None], Sequence[float | None]]],
    *,
    note: str,
    is_foldable: bool = True,
) -> list[TableBlock]:
    """Table of points (`entries`: name, coordinates [mm], standard deviations [mm]) with expanded uncertainties.

    A coordinate with the standard deviation 0 defines the frame: a dash stands for its uncertainty. `title` and `note`
    are texts above and below the table. With `is_foldable` the page shows only the title of a long table.
    """
    expanded_uncertainty_um = [
        [None if value is None or value == 0 else 2e3 * value for value in sigma] for *_, sigma in entries
    ]
    table_rows = [
        [name, *point, *expanded] for (name, point, _), expanded in zip(entries, expanded_uncertainty_um, strict=True)
    ]
    exact = [name for name, _, sigma in entries if any(value == 0 for value in sigma)]
    note = f"U: expanded uncertainty, k = 2. {note}"
    if exact:
        verb, pronoun = ("have", "they define") if len(exact) > 1 else ("has", "it defines")
        note += f" {names_text(exact, 4)} {verb} no U in coordinates that are exact, because {pronoun} the frame."
    return table_blocks(title, STATION_COORDINATES_TABLE.with_rows(table_rows), note=note, is_foldable=is_foldable)


def target_uncertainty_sentence(sigma: Floats) -> str:
    """Sentence on the typical and the largest uncertainty of T targets with standard deviations `sigma` (T, 3) [m].

    For a target without a determined height (NaN) the uncertainty is the horizontal one. The sentence is empty if no
    target is determined.
    """
    determined = sigma[np.isfinite(sigma[:, :2]).all(axis=1)]
    is_in_plan = bool(np.isnan(determined).any())
    point_sigmas = np.sort(np.sqrt((determined[:, : 2 if is_in_plan else 3] ** 2).sum(axis=1)))
    if not len(point_sigmas):
        return ""
    typical, worst = (number_text(2e6 * s, 2) for s in (np.median(point_sigmas), point_sigmas[-1]))
    space_text = "plan" if is_in_plan else "space"
    return f"Expanded uncertainty of a target in {space_text}: U = {typical} um (k = 2), {worst} um for the worst."


def recording_section(folder: Path, *, hall_view: HallView = "3d", omits_residuals: bool = False) -> Section:
    """Section of a recording; with `omits_residuals`, the section of its calibration shows the residuals.

    Raises
    ------
    RecordError
        When the recording cannot be read.
    """
    from ltsim.reports.workshop_scene import workshop_from_adjustment

    recording = read(folder)
    title = f"Recording: {recording.setup.title}" if recording.setup.title else "Recording of a tracker network"
    facts = [
        KeyFigure("stations", str(len(recording.stations))),
        KeyFigure("targets", str(len(recording.targets))),
        KeyFigure("pointings", str(len(recording))),
        KeyFigure("known lengths", str(len(recording.gauge.distance))),
    ]
    last_blocks: list[Block] = [*_station_work_tables(recording), _settings_block(folder)]
    try:
        networks = networks_without_and_with_parameters(recording)
    except (NetworkError, ConvergenceError) as problem:
        answer = f"{_recording_size_sentence(recording)} The network could not be adjusted: {problem}."
        return Section(title, "Recording", answer, "bad", facts, last_blocks)
    without_parameters, with_parameters = (network.adjustment for network in networks)
    corrections_text = f" {networks[1].corrections_text}".rstrip()
    agrees, agreement_text = global_test_verdict(with_parameters.chi2, with_parameters.dof, with_parameters.p_value)
    flagged_readings = with_parameters.flagged_readings()
    outlier_text = f" Outliers: {count_text(len(flagged_readings), 'reading')}." if flagged_readings else ""
    facts += [
        KeyFigure(
            "sigma0", f"{np.sqrt(with_parameters.chi2 / max(with_parameters.dof, 1)):.3f}", assessment_of(agrees)
        ),
        KeyFigure(
            "p-value, two-sided", p_value_text(two_sided_p_value(with_parameters.p_value)), assessment_of(agrees)
        ),
        KeyFigure("outliers", str(len(flagged_readings)), "bad" if flagged_readings else "plain"),
    ]
    assessment = assessment_of(agrees and not flagged_readings)
    if assessment == "good" and corrected_faults(networks[1].tests):
        assessment = "caution"
    workshop = (
        workshop_from_adjustment(with_parameters, adjustment_without_parameters=without_parameters)
        if hall_view != "none"
        else None
    )
    if not omits_residuals:
        before, after = Residuals.from_adjustment(without_parameters), Residuals.from_adjustment(with_parameters)
        last_blocks = [*residual_figures(after, before), *last_blocks]
    del without_parameters, with_parameters, networks  # whose designs take more memory than all pictures
    blocks = workshop_blocks(lambda: workshop, hall_view) if workshop is not None else []
    size_sentence = _recording_size_sentence(recording)
    answer = (
        f"{size_sentence} With the instrument's parameters adjusted, {agreement_text}.{corrections_text}{outlier_text}"
    )
    return Section(
        title,
        "Recording",
        answer,
        assessment,
        facts,
        [*blocks, *last_blocks],
        n_open_blocks=2,
    )


def _recording_size_sentence(recording: Recording) -> str:
    """Sentence on the number of pointings, stations, targets and faces, and on the duration."""
    faces = "two faces" if (recording.face == 2).any() else "one face"
    time = f" over {duration_text(float(np.ptp(recording.time)))}" if recording.has_clock and len(recording) else ""
    return (
        f"{count_text(len(recording), 'pointing')} from {count_text(len(recording.stations), 'station')} to "
        f"{count_text(len(recording.targets), 'target')} in {faces}{time}."
    )


def _station_work_tables(recording: Recording) -> list[TableBlock]:
    """List with the table of the work of each station: pointings, targets, faces, time."""
    table_rows = []
    for s, name in enumerate(recording.stations):
        is_at_station = recording.station == s
        counts = (
            is_at_station.sum(),
            len(set(recording.target[is_at_station].tolist())),
            len(set(recording.face[is_at_station].tolist())),
        )
        start_text = duration_text(float(recording.time[is_at_station].min())) if recording.has_clock else MISSING_TEXT
        table_rows.append([name, *map(int, counts), int((~recording.is_measured[is_at_station]).sum()), start_text])
    return table_blocks("Work of each station", STATION_WORK_TABLE.with_rows(table_rows))


def _settings_block(folder: Path) -> Block:
    """Block with the `setup.toml` of a recording; a note if the folder has none."""
    file = folder / "setup.toml"
    if not file.is_file():
        return NoteBlock("Set-up", "There is no setup.toml; the default noise and priors were used.")
    return CodeBlock("Set-up of the recording (setup.toml)", read_text(file))
