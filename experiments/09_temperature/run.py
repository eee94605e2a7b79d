"""Instrument parameters from 27 C applied at 20 C: limit of the thermal change up to which they help."""

from dataclasses import replace

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, campaign, write_figure
from ltsim.reports.figures.campaign import SweepPoint, sweep_panels_figure, sweep_points

DRIFTS = (0.0, 0.25, 0.5, 1.0)
"""Changes of the parameters over 7 K, as fractions of the prior (9.7 urad, 14 um): 0.25 is 0.35 urad and 0.5 um per
kelvin.
"""
AS_READ = "new_point_error_raw_um"


def run(options: Options) -> RunRecord:
    rows: list[SweepPoint] = []
    for drift in DRIFTS:
        results = campaign("config.toml", options, f"drift-{drift:g}", validation_drift=drift)
        rows += [
            replace(s, level=drift) for s in sweep_points(results, ERROR, "gauge_scale_ppm", panel="gauge_scale_ppm")
        ]
        as_read = sweep_points(results, AS_READ, "gauge_scale_ppm", panel="gauge_scale_ppm", method="network")
        rows += [replace(s, level=drift, line_label="not calibrated") for s in as_read]
    figure = sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title="change until it is used, over the prior")
    for ax in figure.axes:
        # Logarithmic, because eq. 9 with a wrong gauge gives errors many times larger than those without calibration.
        ax.set(yscale="log", yticks=(ticks := (10, 20, 50, 100, 200, 500)), yticklabels=ticks)
    write_figure(options.out / "new_points.svg", figure)
    return RunRecord(results.manifest.seed, results.manifest.trials)
