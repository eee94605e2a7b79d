"""Instrument parameters from 27 C applied at 20 C: limit of the thermal change up to which they help."""

from dataclasses import replace

from experiments.common import ERROR, NEW_POINTS, Made, Options, campaign, write_figure
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure, sweep_points

DRIFTS = (0.0, 0.25, 0.5, 1.0)
"""Of the prior, 9.7 urad and 14 um, over 7 K: a share of 0.25 is 0.35 urad and 0.5 um per kelvin."""
AS_READ = "new_point_error_raw_um"


def run(given: Options) -> Made:
    rows: list[SweepPoint] = []
    for drift in DRIFTS:
        results = campaign("config.toml", given, f"drift-{drift:g}", validation_drift=drift)
        rows += [
            replace(s, level=drift) for s in sweep_points(results, ERROR, "gauge_scale_ppm", panel="gauge_scale_ppm")
        ]
        as_read = sweep_points(results, AS_READ, "gauge_scale_ppm", panel="gauge_scale_ppm", method="network")
        rows += [replace(s, level=drift, line_label="not calibrated") for s in as_read]
    figure = sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title="change until it is used, over the prior")
    for ax in figure.axes:
        # A wrong gauge makes eq. 9 many times worse than nothing: it is shown.
        ax.set(yscale="log", yticks=(ticks := (10, 20, 50, 100, 200, 500)), yticklabels=ticks)
    write_figure(given.out / "new_points.svg", figure)
    return Made(results.manifest.seed, results.manifest.trials)
