"""Calibrations with gauges of 0 to 6 reflectors, and with harmonics of order 2, 3 and 4."""

from dataclasses import replace

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, campaign, write_figure, write_paired_differences
from ltsim.reports.figures.campaign import NOISE_FLOOR_LABEL, cell_rows_figure, sweep_panels_figure, sweep_points


def run(options: Options) -> RunRecord:
    gauges, orders = campaign("gauge.toml", options), campaign("config.toml", options, "harmonics")
    figure = cell_rows_figure(sweep_points(gauges, ERROR, ("title", "range_scale_ppm")), x_label=NEW_POINTS)
    figure.axes[0].set_ylabel("reflectors of the gauge, true error of the range scale")
    write_figure(options.out / "gauge.svg", figure)
    rows = sweep_points(orders, ERROR, "beyond_second_urad")
    # The true parameters contain only order 2, so only the cell without higher orders shows the noise alone.
    floor = next(row for row in rows if row.line_label == NOISE_FLOOR_LABEL and not row.level)
    rows = [replace(floor, level=row.level) if row.line_label == NOISE_FLOOR_LABEL else row for row in rows]
    axis = "each coefficient of orders 3 and 4 in the truth [µrad]"
    write_figure(options.out / "harmonics.svg", sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title=axis))
    pairs = orders.paired_differences(ERROR, method=("order 2", "order 4"))
    write_paired_differences(options.out / "paired.csv", pairs)
    return RunRecord(orders.manifest.seed, orders.manifest.trials)
