"""An instrument's parameters over its calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import takewhile

import numpy as np
from matplotlib.figure import Figure

from ltsim.calibration.history_schema import CourseEntry
from ltsim.pages.style import AFTER, GREY, PALE, new_figure, quiet_axis, shorten, styled, unit_text


def told_apart(labels: Sequence[str]) -> tuple[str, ...]:
    """Labels without the words that all of them begin with, where something is left then."""
    if len(set(labels)) < 2:
        return tuple(labels)
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*labels, strict=False))
    common = "".join(letters[0] for letters in alike)
    begin = 1 + max(common.rfind(separator) for separator in "_- .")
    short = tuple(label[begin:] for label in labels)
    return short if all(short) else tuple(labels)


@styled
def history_figure(names: Sequence[str], courses: Sequence[CourseEntry]) -> Figure:
    """A panel a parameter over calibrations: estimates with 95 % intervals, the band in which true values lie."""
    columns = 2 if len(courses) > 1 else 1
    rows = max(1, -(-len(courses) // columns))
    figure = new_figure(0.7 + 1.35 * rows)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    labels = [shorten(name, 24) for name in told_apart(names)]
    place = np.arange(len(labels))
    for ax, course in zip(panels.ravel(), courses, strict=False):
        band = (course.mean - course.spread, course.mean + course.spread)
        ax.axhspan(*band, color=PALE, zorder=0, label="mean ± spread between calibrations")
        ax.axhline(0.0, color=GREY, linewidth=0.7, zorder=1)
        half = 1.96 * np.array(course.sigmas)
        ax.errorbar(place, course.values, half, fmt="o", ms=3.5, color=AFTER, lw=1.2, label="estimate, 95 % interval")
        ax.set_title(f"{course.name} [{unit_text(course.unit)}]")
        ax.set_xticks(place, labels, rotation=60, ha="right", fontsize=7)
        ax.set_xlim(-0.5, len(place) - 0.5)
        quiet_axis(ax)
    for ax in panels.ravel()[len(courses) :]:
        ax.set_axis_off()
        panels[-2, -1].tick_params(labelbottom=True)
    if courses:
        figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return figure
