"""Figures of displacements of points, of acceptance tests, and of a field check."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ltsim.acceptance.files import AcceptanceFile
from ltsim.adjustment.fieldcheck.result import Check, SetupCheck
from ltsim.adjustment.fieldcheck.setup_model import SetupModel
from ltsim.measurands.comparison import Comparison
from ltsim.physics.model.construction import declared_construction
from ltsim.reports import style
from ltsim.reports.figures.floor_plan import MapLabel, draw_labels

DISPLACEMENT_PROJECTIONS = (("seen from above", 0, 1), ("side view", 0, 2))
"""Projections of displacements: title, and indices of the two coordinate axes."""


@style.with_figure_style
def displacement_figure(comparison: Comparison) -> Figure:
    """Figure of displacements of points as lines with a common magnification, in two projections.

    The circle at the end of a line has the largest semi-axis of the 95 % ellipsoid as its radius.
    """
    points = comparison.displacements
    positions, shifts, semi_axes = (
        np.array([getattr(d, name) for d in points]) for name in ("position_mm", "displacement_um", "semi_axes_um")
    )
    moved, names = np.array([d.moved for d in points], dtype=bool), [d.target for d in points]
    figure = style.new_figure(3.0)
    longest = max(np.linalg.norm(shifts, axis=1).max(), semi_axes.max(), 1e-9)
    mm_per_um = float(0.125 * (np.ptp(positions, axis=0).max() or 1.0) / longest)  # to an eighth of the picture
    figure.suptitle(f"displacements are enlarged {1e3 * mm_per_um:.0f} times", x=0.01, ha="left", fontsize=7.5)
    for ax, (title, i, j) in zip(figure.subplots(1, 2), DISPLACEMENT_PROJECTIONS, strict=True):
        for position, shift, axes, has_moved in zip(positions, shifts, semi_axes, moved, strict=True):
            colour = style.RED if has_moved else style.COLOUR_AFTER
            start, end = position[[i, j]], position[[i, j]] + mm_per_um * shift[[i, j]]
            angles = np.linspace(0, 2 * np.pi, 60)
            circle = end[:, None] + mm_per_um * axes[0] * np.stack([np.cos(angles), np.sin(angles)])
            ax.plot(*circle, color=style.GREY, linewidth=0.7)
            ax.plot([start[0], end[0]], [start[1], end[1]], color=colour, linewidth=1.8 if has_moved else 1.0)
            ax.plot(*start, marker="s" if has_moved else "o", markersize=3.5, color=colour, linestyle="none")
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(title)
        ax.set_xlabel(f"{'xyz'[i]} [mm]")
        ax.set_ylabel(f"{'xyz'[j]} [mm]")
    moved_indices = np.flatnonzero(moved)
    for ax, (_, i, j) in zip(figure.axes, DISPLACEMENT_PROJECTIONS, strict=True):
        draw_labels(
            figure,
            ax,
            [MapLabel(names[k], positions[k, [i, j]], colour=style.RED) for k in moved_indices],
            positions[:, [i, j]],
        )
    return figure


JUDGEMENT_MARKERS = (
    ("accepted", "o", 2.6, style.BLUE, style.BLUE),
    ("undecided", "o", 3.6, style.INK_COLOUR, "none"),
    ("rejected", "x", 5.0, style.RED, style.RED),
)
"""Judgement of a test, and the marker for it: form, size [pt], colour of the edge and of the face."""
MAX_MARKER_OFFSET_IN_GROUP_ROW = 0.32
"""Largest distance of the markers of a group of tests from the row of the group, as a fraction of the row spacing."""


@style.with_figure_style
def error_to_limit_figure(content: AcceptanceFile) -> Figure:
    """Figure of the error of each acceptance test divided by its limit, one row per group of tests.

    Bars are expanded uncertainties; the marker shows the judgement.
    """
    group_names = [g.name for g in content.groups]
    figure, ax = style.new_panel(0.9 + 0.42 * max(len(group_names), 3))
    rows = style.set_category_rows(ax, group_names)
    ax.axvspan(-1, 1, color=style.BLUE, alpha=0.08, lw=0)
    for edge in (-1, 1):
        ax.axvline(edge, color=style.INK_COLOUR, lw=0.8)
    for row, name in zip(rows, group_names, strict=True):
        group_tests = [t for t in content.tests if t.group == name]
        error_ratios = np.array([t.error_um / t.limit_um for t in group_tests])
        uncertainty_ratios = np.array([(t.expanded_uncertainty_um or 0.0) / t.limit_um for t in group_tests])
        heights = row + np.linspace(
            -MAX_MARKER_OFFSET_IN_GROUP_ROW, MAX_MARKER_OFFSET_IN_GROUP_ROW, len(group_tests)
        ) * (len(group_tests) > 1)
        judgements = np.array(
            [
                t.judgement or ("accepted" if abs(s) <= 1 else "rejected")
                for t, s in zip(group_tests, error_ratios, strict=True)
            ]
        )
        ax.hlines(
            heights,
            error_ratios - uncertainty_ratios,
            error_ratios + uncertainty_ratios,
            color=style.BLUE,
            lw=0.6,
            alpha=0.6,
        )
        for judgement, marker, size, edge_colour, face_colour in JUDGEMENT_MARKERS:
            has_judgement = judgements == judgement
            edge_width = 1.4 if marker == "x" else 0.7
            ax.plot(
                error_ratios[has_judgement],
                heights[has_judgement],
                marker,
                ms=size,
                mec=edge_colour,
                mfc=face_colour,
                mew=edge_width,
                ls="none",
            )
    largest = max(1.0, *(abs(t.error_um) / t.limit_um for t in content.tests))
    ax.set_xlim(-1.15 * largest, 1.15 * largest)
    ax.set_xlabel("error / limit")
    return figure


TWO_FACE_COMPONENT_MARKERS = (
    ("range", style.BLUE, "o"),
    ("across the beam", style.ORANGE, "s"),
    ("elevation", style.GREEN, "^"),
)
"""Component of a two-face difference, with the colour and the form of its marker."""
MAX_TARGETS_WITH_AXIS_NAMES = 40
"""Largest number of targets whose names are written on the axis."""
MAX_LEGEND_STATIONS = 8
"""Largest number of stations in a legend; only the first stations are listed."""
MAX_LEGEND_NAME_LENGTH = 20
"""Largest length of the name of a station in a legend [characters]."""
AXES_HEIGHT_FRACTION_BELOW_LEGEND = 0.86
"""Fraction of the height of the axes that stays free below a legend inside the axes."""


@style.with_figure_style
def field_check_figure(check: Check) -> Figure:
    """Figure of a field check: half two-face differences divided by their limits, and below rms residuals over time."""
    figure = style.new_figure(5.2)
    above, below = figure.subplots(2, 1)
    _draw_two_face_differences(above, check)
    _draw_misfit_over_time(below, check)
    figure.suptitle(
        "go" if check.passed else "no-go", x=0.01, ha="left", color=style.GREEN if check.passed else style.RED
    )
    return figure


def _draw_two_face_differences(ax: Axes, check: Check) -> None:
    """Draw half two-face differences divided by their limits, by target, with the stations side by side."""
    names: list[str] = []
    n_drawn, recording = 0, check.arrays.recording
    for setup in check.arrays.setup_checks:
        if setup.two_face_differences is None:
            continue
        ratios = (
            setup.two_face_differences.uncorrected_pairs.half_differences
            / setup.two_face_differences.half_difference_limits
        )
        places = n_drawn + np.arange(len(ratios))
        for column, (component, colour, marker) in enumerate(TWO_FACE_COMPONENT_MARKERS):
            label = component if n_drawn == 0 else None
            ax.plot(places, ratios[:, column], marker, ms=3.2, color=colour, label=label, alpha=0.85)
        rows = setup.row_numbers[setup.two_face_differences.uncorrected_pairs.pointing_indices[:, 0]] - 1
        names += [recording.targets[recording.target[row]] for row in rows]
        n_drawn += len(ratios)
        ax.axvline(n_drawn - 0.5, ymax=AXES_HEIGHT_FRACTION_BELOW_LEGEND, color=style.INK_COLOUR, lw=0.4)
    for limit in (-1.0, 1.0):
        ax.axhline(limit, color=style.RED, lw=1.0)
    style.set_grid(ax)
    ax.set_title("Half two-face differences divided by their limits")
    ax.set_ylabel("fraction of the limit")
    if not names:
        ax.text(0.5, 0.5, "no target was measured on both faces", transform=ax.transAxes, ha="center")
        ax.set_xticks([])
        return
    ax.set_xlim(-0.8, n_drawn - 0.2)
    low, high = ax.get_ylim()
    ax.set_ylim(low, low + (high - low) / AXES_HEIGHT_FRACTION_BELOW_LEGEND)
    shows_names = len(names) <= MAX_TARGETS_WITH_AXIS_NAMES
    ax.set_xticks(
        range(n_drawn) if shows_names else [],
        [style.shortened_name(n) for n in names] if shows_names else [],
        rotation=90,
        fontsize=6,
    )
    ax.legend(loc="upper right", ncols=3)


def _draw_misfit_over_time(ax: Axes, check: Check) -> None:
    """Draw the rms whitened residual of each pointing over time, with the intervals in which a tracker moved."""
    is_corrected = False
    seconds_per_unit, unit = (60.0, "time [min]") if check.arrays.recording.has_clock else (1.0, "pointing")
    for i, setup in enumerate(check.arrays.setup_checks):
        if setup.setup_model is None:
            continue
        if (measured := _setup_model_as_measured(check, setup)) is not None:
            ax.plot(
                measured.recording.time / seconds_per_unit,
                np.sqrt(np.mean(measured.whitened_residuals**2, axis=1)),
                "o",
                ms=5,
                mfc="none",
                color=style.RED,
                label=None if is_corrected else "as measured",
            )
            is_corrected = True
        misfit = np.sqrt(np.mean(setup.setup_model.whitened_residuals**2, axis=1))
        label = style.shortened_name(setup.station, MAX_LEGEND_NAME_LENGTH) if i < MAX_LEGEND_STATIONS else None
        ax.plot(
            setup.setup_model.recording.time / seconds_per_unit,
            misfit,
            ".",
            ms=4,
            color=style.COLOUR_CYCLE[i % len(style.COLOUR_CYCLE)],
            label=label,
        )
    has_label = False
    for item in check.items:
        if item.motion_interval_s is not None:
            ax.axvspan(
                item.motion_interval_s[0] / seconds_per_unit,
                item.motion_interval_s[1] / seconds_per_unit,
                color=style.RED,
                alpha=0.35,
                lw=0,
            )
            ax.axvline(
                item.motion_interval_s[0] / seconds_per_unit,
                color=style.RED,
                lw=1.0,
                label=None if has_label else "moved",
            )
            has_label = True
    style.set_grid(ax)
    ax.set_title("Misfit of each pointing (dots: motion corrected)" if is_corrected else "Misfit of each pointing")
    ax.set_xlabel(unit)
    ax.set_ylabel("rms [sigma]")
    ax.set_ylim(0, 1.3 * ax.get_ylim()[1])
    if not ax.lines:
        ax.text(0.5, 0.5, "no target was measured twice from one set-up", transform=ax.transAxes, ha="center")
    if names := ax.get_legend_handles_labels()[1]:
        ax.legend(loc="upper right", ncols=style.n_legend_columns(names, 5))


def _setup_model_as_measured(check: Check, setup: SetupCheck) -> SetupModel | None:
    """Model of the uncorrected readings of a set-up; None if the field check did not correct them.

    A no-go because of an identified cause is decided on the uncorrected readings; the tests of the set-up are made on
    readings corrected for this cause.
    """
    assert setup.setup_model is not None
    measured = check.arrays.recording.select(setup.row_numbers - 1)
    if np.array_equal(measured.readings, setup.setup_model.recording.readings, equal_nan=True):
        return None
    return SetupModel.from_recording(measured, declared_construction(measured))
