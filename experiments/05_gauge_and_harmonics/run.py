"""Gauges of 0 to 6 reflectors; harmonics up to order 2, 3 and 4 fitted to truths that go beyond the second."""

from dataclasses import replace

from experiments.common import ERROR, NEW_POINTS, Made, Options, campaign, write_figure, write_pairs
from ltsim.reports.figures.campaign import FLOOR, by_factor, by_setting, swept


def run(given: Options) -> Made:
    gauges, orders = campaign("gauge.toml", given), campaign("config.toml", given, "harmonics")
    figure = by_setting(swept(gauges, ERROR, ("title", "range_scale_ppm")), label=NEW_POINTS)
    figure.axes[0].set_ylabel("reflectors of the gauge, true error of the range scale")
    write_figure(given.out / "gauge.svg", figure)
    rows = swept(orders, ERROR, "beyond_second_urad")
    # True parameters leave what lies beyond the second order: the noise alone shows where there is nothing beyond it.
    floor = next(row for row in rows if row.line == FLOOR and not row.x)
    rows = [replace(floor, x=row.x) if row.line == FLOOR else row for row in rows]
    axis = "each coefficient of orders 3 and 4 in the truth [µrad]"
    write_figure(given.out / "harmonics.svg", by_factor(rows, label=NEW_POINTS, axis=axis))
    write_pairs(given.out / "paired.csv", orders.paired(ERROR, method=("order 2", "order 4")))
    return Made(orders.manifest.seed, orders.manifest.trials)
