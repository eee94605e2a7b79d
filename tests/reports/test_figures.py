"""Every figure shows its data, reads in print and gives the same bytes twice."""

from __future__ import annotations

import io
import itertools
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib import image
from matplotlib.figure import Figure
from matplotlib.text import Text

from ltsim.acceptance.files import AcceptanceFile
from ltsim.adjustment.evaluation.criteria import CRITERIA_TABLE
from ltsim.adjustment.fieldcheck.check import check as check_of
from ltsim.adjustment.fieldcheck.result import Check
from ltsim.calibration.calibration_series import ChiSquareEntry
from ltsim.calibration.history import ParameterHistory
from ltsim.calibration.schema import ParameterEntry
from ltsim.campaigns.summary import ZScoreSummary
from ltsim.core.notation import fixed_point_text, number_text, with_sigma
from ltsim.core.randomness import random_stream
from ltsim.diagnosis.schema import FindingScope, ResponseCurve
from ltsim.measurands.comparison import Comparison
from ltsim.planning.plan_entries import PlannedParameterEntry as PlannedEntry
from ltsim.planning.reflector_changes import ReflectorChangeEntry
from ltsim.planning.result import Plan
from ltsim.recordings.specification import data_sheet_specification
from ltsim.reports import style
from ltsim.reports.figures import (
    campaign as sweeps,
    floor_plan as floors,
    marked_floor_plans as marked_floors,
    parameters as estimates,
    points as points,
    residuals as misfits,
)
from ltsim.reports.formatting import labels_without_common_prefix, typographic_text
from ltsim.reports.residuals import Residuals
from ltsim.reports.sections.campaign_coverage import coverage_sentence
from ltsim.reports.workshop_scene import workshop_from_adjustment, workshop_from_scenario
from ltsim.simulation.scenario import load_scenario
from tests.families import family
from tests.networks import network
from tests.reports import samples

DEFAULT = {colour.lower() for colour in mpl.colors.TABLEAU_COLORS.values()}
"""What matplotlib takes by itself: a red and a green among them that one man in twelve cannot tell apart."""
MARKUP = "<b>$x_1$&</b>"


def residuals() -> tuple[Residuals, Residuals]:
    return Residuals.from_adjustment(samples.before()), Residuals.from_adjustment(samples.after())


def parameters() -> list[ParameterEntry]:
    adjusted = samples.after()
    sigma = np.sqrt(np.diag(adjusted.first_instrument_covariance))
    return [
        ParameterEntry(
            name=p.name,
            value=v / p.si_per_display_unit,
            sigma=s / p.si_per_display_unit,
            unit=p.unit,
            prior_sigma=p.prior_sigma / p.si_per_display_unit,
        )
        for p, v, s in zip(
            adjusted.construction.parameters, adjusted.state.instrument_parameters[0], sigma, strict=True
        )
    ]


def correlation_figure() -> Figure:
    return estimates.correlation_figure(parameters(), samples.after().first_instrument_covariance)


def cell_rows_figure() -> Figure:
    rows = [
        sweeps.SweepPoint(f"noise {s} {MARKUP}", method, "", 40.0 + s, 39.0 + s, 41.0 + s, 20.0 + s, 60.0 + s)
        for s in range(3)
        for method in ("network", "distance")
    ]
    return sweeps.cell_rows_figure(rows, x_label="improvement [%]", published_value=40.1)


def sweep_panels_figure() -> Figure:
    rows = [
        sweeps.SweepPoint(x, method, f"faces {panel} {MARKUP}", x + m, x + m - 0.2, x + m + 0.2, x + m - 2, x + m + 2)
        for x in (1.0, 2.0, 4.0, 10.0)
        for m, method in enumerate(("network", "distance"))
        for panel in (1, 2)
    ]
    return sweeps.sweep_panels_figure(rows, statistic_title="error [µm]", x_title="noise factor", published_value=3.0)


def predicted_sigmas_figure() -> Figure:
    rows = [PlannedEntry(name=f"parameter-{i}", unit="urad", sigma=1.0 + i, prior_sigma=15.0) for i in range(6)]
    alone = PlannedEntry(name="alone", unit="um", sigma=3.0, prior_sigma=20.0)
    return estimates.predicted_sigmas_figure([*rows, alone], {f"parameter-{i}": 2.0 + i for i in range(6)})


def parameter_history_figure() -> Figure:
    labels = ("2021-09", "2021-10", MARKUP)
    values = np.array([1.0, 2.0, 1.5])
    test = ChiSquareEntry(chi2=1.0, dof=2, p_value=0.6)
    constant = {
        "unit": "urad",
        "sigmas": (0.3, 0.3, 0.3),
        "mean": 1.5,
        "between_calibration_sigma": 0.5,
        "constancy_test": test,
    }
    courses = [ParameterHistory(name=f"parameter-{i}", values=tuple(values * (i + 1)), **constant) for i in range(3)]
    return estimates.parameter_history_figure(labels, courses)


def error_to_limit_figure() -> Figure:
    groups = ("bar", MARKUP)
    tests = [
        {
            "name": f"{g} {i}",
            "group": g,
            "limit_um": 40.0,
            "error_um": 15.0 * i,
            "expanded_uncertainty_um": 8.0,
            "pass_probability": float(i < 3),
        }
        for g in groups
        for i in range(4)
    ]
    content = AcceptanceFile.model_validate(
        {
            "error_origin": "measured",
            "plan_name": "mine",
            "specification": data_sheet_specification("leica-at500"),
            "pass_probability": 0,
            "sentence": "",
            "groups": [{"name": g, "n_tests": 4, "pass_probability": 0, "largest_limit_ratio": 1.1} for g in groups],
            "tests": tests,
        }
    )
    return points.error_to_limit_figure(content)


def criteria_before_after_figure() -> Figure:
    rows = [("distance", 29, 60, 17, 39, 40.1), ("worse", 3.26, 39, 29, 60, -70.6)]
    return estimates.criteria_before_after_figure(CRITERIA_TABLE.with_rows(rows))


def distributions_figure() -> Figure:
    draws = random_stream(1, "figure").normal(29, 4, (4, 500))
    names = ("coordinate, improvement", "distance, mean after", "coordinate, largest before", MARKUP)
    rows = [sweeps.TrialDistribution(name, v, "um", 30.0) for name, v in zip(names, draws, strict=True)]
    return sweeps.distributions_figure(rows)


def floor_plan() -> Figure:
    return floors.floor_plan(workshop_from_adjustment(samples.after()))


def parameter_estimates_figure() -> Figure:
    return estimates.parameter_estimates_figure(parameters(), [0.0] * len(parameters()))


def reflector_changes_floor_plan() -> Figure:
    changes = [ReflectorChangeEntry.model_validate(change) for change in samples.REFLECTOR_CHANGES]
    return marked_floors.reflector_changes_floor_plan(workshop_from_scenario(load_scenario("paper-workshop")), changes)


def residuals_by_covariate_figure() -> Figure:
    return misfits.residuals_by_covariate_figure(residuals()[1])


def residuals_by_station_figure() -> Figure:
    first, second = residuals()
    return misfits.residuals_by_station_figure(second, first)


def finding_comparison_figure() -> Figure:
    first, second = residuals()
    return misfits.finding_comparison_figure(
        first, second, "elevation", FindingScope(observables=("elevation",), stations=("S2",))
    )


def trade_off_figure() -> Figure:
    tried = [{"station_count": 2 + i, "hours": 0.3 + i / 60, "qualities": {MARKUP: 9.0 - 0.2 * i}} for i in range(12)]
    best = {"station_count": 3, "hours": 0.4, "qualities": {MARKUP: 5.0}, "is_efficient": True}
    plan = {"summary": "", "stations": [], "hours": 0.7, "qualities": {MARKUP: 3.0}, "tradeoff_points": [*tried, best]}
    return estimates.trade_off_figure(Plan.model_validate(plan), MARKUP)


def variance_budget_figure() -> Figure:
    return estimates.variance_budget_figure(
        ["length", MARKUP], {"readings": [0.7, 0.2], "weather": [0.3, 0.5], MARKUP: [0.0, 0.3]}
    )


def field_check_figure() -> Figure:
    return points.field_check_figure(check_of(samples.recording()))


def displacement_figure() -> Figure:
    draws = random_stream(3, "figure").standard_normal((2, 6, 3))
    names = ["T1", "T1", "T1", "T1", "T1", MARKUP]
    epoch = {"sigma_um": (1, 1, 1), "covariance_um2": np.eye(3).tolist(), "p_value": 0.5, "detectable_um": (1, 2)}
    displacements = [
        {"target": name, "moved": i in (0, 5), "position_mm": (1e3 * place).tolist(),
         "displacement_um": (20 * shift).tolist(), "semi_axes_um": (15, 15, 15), **epoch}
        for i, (name, place, shift) in enumerate(zip(names, *draws, strict=True))
    ]  # fmt: skip
    whole = {
        "second_recording": None,
        "sentence": "",
        "significance_level": 0.05,
        "statistic": 1,
        "dof": 1,
        "p_value": 1,
        "p_value_without_moved_points": 1,
    }
    return points.displacement_figure(Comparison.model_validate({**whole, "displacements": displacements}))


def response_curve_figure() -> Figure:
    at = np.linspace(-0.6, 0.9, 40)
    value, sigma = (3.0 * np.sin(3 * at)).tolist(), [0.4] * 40
    curve = ResponseCurve(covariate="elevation", unit="um", at=at.tolist(), value=value, sigma=sigma)
    return misfits.response_curve_figure(curve, "distance", residuals()[0])


def scores(z: np.ndarray) -> list[ZScoreSummary]:
    shares = (np.abs(z) <= 1.96).mean(axis=1)
    return [z_scores_of(f"parameter-{i}", z.shape[1], float(share)) for i, share in enumerate(shares)]


def z_scores_of(parameter: str, trials: int, coverage: float) -> ZScoreSummary:
    values = {"mean": 0.0, "standard_deviation": 1.0, "coverage_95": coverage}
    return ZScoreSummary(cell=0, method="network", parameter=parameter, trials=trials, **values)


def coverage_figure() -> Figure:
    return sweeps.coverage_figure(scores(random_stream(2, "figure").standard_normal((5, 400))))


def injected_and_estimated_figure() -> Figure:
    at = np.linspace(0, 30, 40)
    return misfits.injected_and_estimated_figure(
        at, np.sin(at), 1.1 * np.sin(at), axis="time [min]", label="change [µm]"
    )


def values_with_intervals_figure() -> Figure:
    rows = {"add station S6 at (1.17, 1.08, 1.56) m, and measure all targets": (2.0, 1.0, 3.5), MARKUP: (0.5, 0.5, 0.5)}
    return estimates.values_with_intervals_figure(
        rows, "error of a new point [um]", reference_values={"as read": [4.0], "limits": [0.0, 3.0]}
    )


def lines_with_intervals_figure() -> Figure:
    lines = {"found": [(0.2, 0.0, 0.6), (1.0, 0.6, 1.0)], "named": [(0.0, 0.0, 0.4), (0.8, 0.4, 1.0)]}
    return estimates.lines_with_intervals_figure([25.0, 400.0], lines, "noncentrality", "share, 95 % interval")


def marked_floor_plan() -> Figure:
    names = samples.recording().targets[:2]
    return marked_floors.marked_floor_plan(workshop_from_adjustment(samples.after()), names, [names])


DRAWINGS = {
    f.__name__: f
    for f in (
        error_to_limit_figure, variance_budget_figure, sweep_panels_figure, cell_rows_figure, field_check_figure,
        correlation_figure, coverage_figure, criteria_before_after_figure, displacement_figure, distributions_figure,
        response_curve_figure, floor_plan, injected_and_estimated_figure, parameter_history_figure,
        lines_with_intervals_figure, parameter_estimates_figure, reflector_changes_floor_plan,
        residuals_by_covariate_figure, residuals_by_station_figure, predicted_sigmas_figure,
        finding_comparison_figure, trade_off_figure, values_with_intervals_figure, marked_floor_plan,
    )
}  # fmt: skip


@cache
def drawn(draw: Callable[[], Figure]) -> Figure:
    """A figure, drawn once for the tests that look at it."""
    return draw()


def pixels(figure: Figure) -> np.ndarray:
    stream_ = io.BytesIO()
    figure.savefig(stream_, format="png", dpi=80)
    stream_.seek(0)
    return np.asarray(image.imread(stream_, format="png"))[:, :, :3]


def test_every_figure_is_drawn_here() -> None:
    modules = (estimates, floors, marked_floors, misfits, points, sweeps)
    drawings = [item for module in modules for item in vars(module).values() if hasattr(item, "__wrapped__")]
    assert {item.__name__ for item in drawings} <= set(DRAWINGS)


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_figure_shows_something_in_every_panel(draw: Callable[[], Figure]) -> None:
    figure = drawn(draw)
    picture = pixels(figure)
    inked = (picture < 0.97).any(axis=2)
    height, width = inked.shape
    assert inked.mean() > 0.01
    for ax in (a for a in figure.axes if a.axison):
        box = ax.get_window_extent()
        scale = 80 / figure.dpi
        x0, x1 = int(box.x0 * scale), int(box.x1 * scale)
        y0, y1 = int(height - box.y1 * scale), int(height - box.y0 * scale)
        inside = inked[y0 + 3 : y1 - 3, x0 + 3 : x1 - 3]
        assert inside.size > 100, f"{ax.get_title()} has no room"
        assert inside.mean() > 0.002, f"{ax.get_title()} is empty"
    border = np.concatenate([inked[0], inked[-1], inked[:, 0], inked[:, width - 1]])
    assert not border.any(), "something is cut off at the edge"


@pytest.mark.parametrize("draw", DRAWINGS.values(), ids=DRAWINGS)
def test_figure_holds_no_script(draw: Callable[[], Figure]) -> None:
    drawing = style.svg_text(draw())
    assert "<b>" not in drawing
    assert "<script" not in drawing
    assert not DEFAULT & set(re.findall(r"#[0-9a-f]{6}", drawing))


@pytest.mark.parametrize("draw", family(DRAWINGS.values(), 6))
def test_figure_is_the_same_twice(draw: Callable[[], Figure]) -> None:
    assert style.svg_text(draw()) == style.svg_text(draw())


def many_correlations() -> Figure:
    """Of a chain with more parameters than a picture has room for names."""
    matrix = np.corrcoef(random_stream(4, "figure").standard_normal((70, 90)))
    rows = [ParameterEntry(name=f"J{i % 3}.eX_cos{i}", value=0.0, unit="um") for i in range(70)]
    return estimates.correlation_figure(rows, matrix)


@pytest.mark.parametrize("draw", [*DRAWINGS.values(), many_correlations], ids=[*DRAWINGS, "many"])
def test_labels_do_not_overlap_and_are_inside(draw: Callable[[], Figure]) -> None:
    """Titles, names of axes and of ticks neither run over each other nor over the edge of the picture."""
    figure = drawn(draw)
    figure.draw_without_rendering()
    edge = figure.bbox.padded(1.0)
    titles, ticks = [], []
    for ax in (a for a in figure.axes if a.axison):
        tick_labels = [t.label1 for t in ax.yaxis.get_major_ticks() if t.label1.get_text()]
        written = [t for t in ax.texts if t.get_text() and t.get_visible()]
        over = [
            t.get_text() for t in written for b in tick_labels if t.get_window_extent().overlaps(b.get_window_extent())
        ]
        assert not over, f"{over} in the names of the axis"
        headings = [t for t in ax.get_children() if isinstance(t, Text) and t not in ax.texts]
        titles += [t for t in (*headings, ax.xaxis.label, ax.yaxis.label) if t.get_text() and t.get_visible()]
        for axis in (ax.xaxis, ax.yaxis):
            low, high = sorted(axis.get_view_interval())
            labels = [t.label1 for t in axis.get_major_ticks() if low <= t.get_loc() <= high and t.label1.get_visible()]
            ticks.append([label for label in labels if label.get_text()])
    for group in (titles, *ticks):
        boxes = [(t.get_text(), t.get_window_extent()) for t in group if t.get_rotation() % 90 == 0]
        for i, (text, box) in enumerate(boxes):
            assert edge.x0 <= box.x0 and box.x1 <= edge.x1 and edge.y0 <= box.y0 and box.y1 <= edge.y1, text
            over = [other for other, its in boxes[i + 1 :] if box.overlaps(its)]
            assert not over, f"{text} runs over {over}"


def test_axes_carry_units() -> None:
    assert any("[µm]" in ax.get_ylabel() for ax in residuals_by_station_figure().axes)
    assert any("[°]" in ax.get_xlabel() for ax in residuals_by_covariate_figure().axes)
    assert all("[m]" in text for text in (floor_plan().axes[0].get_xlabel(), floor_plan().axes[0].get_ylabel()))


def test_a_plan_lists_where_each_tripod_goes() -> None:
    workshop = workshop_from_adjustment(samples.after())
    words = [text.get_text() for text in floors.floor_plan(workshop, lists_coordinates=True).legends[0].get_texts()]
    x, y, z = workshop.station_positions[1]
    assert f"S2: {x:.3f}, {y:.3f}, {z:.3f} m, {np.degrees(workshop.station_yaws[1]) % 360:.0f}°" in words
    others = len(floor_plan().legends[0].get_texts())
    assert len(words) == 2 * max(others, 1 + len(workshop.stations))  # two columns: what is drawn, and the places
    assert words[len(words) // 2] == "station: x, y, z, azimuth 0"


def test_labels_lose_what_they_share() -> None:
    assert labels_without_common_prefix(["tracker_20Sep", "tracker_22Sep"]) == ("20Sep", "22Sep")
    assert labels_without_common_prefix(["one", "two"]) == ("one", "two")
    assert labels_without_common_prefix(["same", "same"]) == ("same", "same")
    assert labels_without_common_prefix(["a-b-", "a-b-1"]) == ("a-b-", "a-b-1")


def test_drawing_changes_no_global_setting() -> None:
    settings = dict(mpl.rcParams)
    criteria_before_after_figure()
    assert dict(mpl.rcParams) == settings


def test_numbers_read_like_numbers() -> None:
    assert typographic_text(with_sigma(-13.66, 3.7, "um")) == "−13.7 ± 3.7 µm"
    assert typographic_text(with_sigma(-0.001, 0.9)) == "0.00 ± 0.90"
    assert typographic_text("turbulence of 0.1 um2/m3") == "turbulence of 0.1 µm²/m³"
    assert [typographic_text(number_text(v)) for v in (0.0, 1234.5, -0.25, float("nan"))] == [
        "0",
        "1234",
        "−0.250",
        "–",
    ]
    assert [typographic_text(fixed_point_text(v, 1)) for v in (-0.26, None)] == ["−0.3", "–"]


def test_coverage_interval_is_wilsons() -> None:
    interval = sweeps.coverage_interval(z_scores_of("a", 100, 0.95))
    assert interval == pytest.approx((0.8882, 0.9785), abs=1e-4)  # Wilson 1927 for 95 of 100


def test_coverage_is_red_exactly_where_its_caption_says() -> None:
    z = random_stream(4, "figure").standard_normal((6, 1000)) * np.array([1.0, 1.2, 1.0, 0.7, 1.0, 1.03])[:, None]
    rows = scores(z)
    (drawn,) = (line for line in sweeps.coverage_figure(rows).axes[0].lines if line.get_color() == style.RED)
    assert (
        sweeps.is_coverage_outside_band(rows)
        == [i in drawn.get_ydata() for i in range(6)]
        == [i in (1, 3) for i in range(6)]
    )
    words = coverage_sentence(rows)
    assert words.endswith(
        "Red: the interval lies outside the allowed band of 93.5 to 96.5 % for parameter-1, parameter-3."
    )
    assert "No parameter is red" in coverage_sentence(rows[:1])


def test_factors_with_words_and_designs_have_axes_that_read() -> None:
    rows = [sweeps.SweepPoint(x, "network", "", 1.0, 0.9, 1.1, 0.5, 1.5) for x in ("no", "yes")]
    ax = sweeps.sweep_panels_figure(rows, statistic_title="error [µm]", x_title="corrected").axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["no", "yes"]
    spread = [sweeps.SweepPoint(x, "network", "noise", 1.0, 0.9, 1.1, 0.5, 1.5) for x in np.geomspace(0.1, 3, 20)]
    ax = sweeps.sweep_panels_figure(spread, statistic_title="error [µm]", x_title="", joins_points=False).axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["0.1", "0.2", "0.5", "1", "2"]
    assert ax.get_xlabel() == "noise"


def test_panels_above_nothing_have_ticks_and_nothing_is_shaded_where_nothing_spreads() -> None:
    rows = [sweeps.SweepPoint(x, "network", panel, 1.0, 0.9, 1.1, 1.0, 1.0) for x in (1.0, 2.0) for panel in "abc"]
    figure = sweeps.sweep_panels_figure(rows, statistic_title="error [µm]", x_title="noise")
    figure.draw_without_rendering()
    is_labelled = [any(t.get_visible() and t.get_text() for t in ax.get_xticklabels()) for ax in figure.axes[:3]]
    assert is_labelled == [False, True, True]
    assert sweeps.CENTRAL_90_PERCENT_LABEL not in [t.get_text() for t in figure.legends[0].get_texts()]


@pytest.mark.parametrize("turn", [0.0, np.pi / 4, 1.0, 5.0])
def test_a_place_with_room_around_it_has_its_name_whichever_way_it_is_turned(turn: float) -> None:
    figure = style.new_figure(3.0)
    ax = figure.subplots()
    ax.set(xlim=(-1, 1), ylim=(-1, 1))
    place = np.zeros(2)
    floors.draw_labels(figure, ax, [floors.MapLabel("S1", place, 9.0, preferred_direction=turn)], place[None])
    assert [text.get_text() for text in ax.texts] == ["S1"]


def test_a_legend_of_long_names_of_stations_leaves_room_for_the_axes() -> None:
    made = samples.recording()
    names = {s: f"HALL-7.NORTH.TRIPOD.{s}" for s in made.stations}
    setup = made.setup.model_copy(update={"stations": {names[k]: v for k, v in made.setup.stations.items()}})
    figure = points.field_check_figure(check_of(made.replace(stations=tuple(names.values()), setup=setup)))
    style.svg_text(figure)  # matplotlib warns where a layout leaves no axes
    assert all(ax.get_position().width > 0.7 for ax in figure.axes)


@pytest.mark.parametrize("words", [1, 4, 40])
def test_a_budget_of_long_names_of_sources_leaves_room_for_the_axes(words: int) -> None:
    figure = estimates.variance_budget_figure(["length"], {f"{'certificate ' * words}{i}": [0.1] for i in range(9)})
    style.svg_text(figure)
    assert all(ax.get_position().height > 0.2 for ax in figure.axes)


def lightness_and_hue(colour: str, sight: np.ndarray) -> np.ndarray:
    """CIE Lab of a colour as an eye with a deficiency sees it."""
    rgb = np.array(mpl.colors.to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.array([[0.4125, 0.3576, 0.1805], [0.2127, 0.7152, 0.0722], [0.0193, 0.1192, 0.9503]])
    white = np.array([0.95047, 1.0, 1.08883])
    f = np.cbrt(np.maximum(xyz @ np.clip(sight @ linear, 0, 1) / white, 0.008856))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


SIGHTS = {
    "full": np.eye(3),
    "no red cones": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green cones": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "no blue cones": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
"""Machado, Oliveira and Fernandes 2009, whole deficiency."""


@pytest.mark.parametrize("sight", SIGHTS)
def test_every_pair_of_colours_is_distinguishable_by_every_eye(sight: str) -> None:
    colours = {c: lightness_and_hue(c, np.array(SIGHTS[sight])) for c in style.COLOUR_CYCLE}
    for first, other in itertools.combinations(style.COLOUR_CYCLE, 2):
        assert np.linalg.norm(colours[first] - colours[other]) > 14, f"{first} and {other}"


def test_no_figure_of_the_results_has_other_line_colours_than_the_common_ones(root: Path) -> None:
    for file in [*root.glob("results/**/*.svg"), *root.glob("docs/**/*.svg")]:
        assert not DEFAULT & set(re.findall(r"#[0-9a-f]{6}", file.read_text())), file


def test_a_check_shows_the_readings_on_which_a_cause_was_decided() -> None:
    recording, _ = network(faces=2, seed=23)
    readings = recording.readings.copy()
    assert not _shows_measured_readings(check_of(recording))
    readings[recording.station == 2, 0] += 1e-3 * np.linspace(0, 1, int((recording.station == 2).sum()))
    changed = check_of(recording.with_readings(readings))
    assert any(test.is_fault for test in changed.tests)
    assert _shows_measured_readings(changed)


def _shows_measured_readings(check: Check) -> bool:
    labels = {line.get_label() for axes in points.field_check_figure(check).axes for line in axes.lines}
    return "as measured" in labels
