"""Errors of new points after calibrations whose declared prior is wrong by a factor of 0.1 to 1000."""

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, campaign, write_figure, write_table
from ltsim.reports.figures.campaign import sweep_panels_figure, sweep_points


def run(options: Options) -> RunRecord:
    results = campaign("config.toml", options)
    for errors in dict.fromkeys(level["error_factor"] for level in results.levels):
        rows = sweep_points(results, ERROR, "prior_factor", panel="noise_factor", error_factor=errors)
        figure = sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title="declared prior over the paper's")
        write_figure(options.out / f"errors-{errors:g}.svg", figure)
    # Ratio of the error after calibration to that of the uncorrected readings, for each instrument.
    ratio = f"{ERROR} / new_point_error_raw_um"
    table = results.query(
        f"SELECT error_factor, noise_factor, prior_factor, method, count(*), avg({ratio}), "
        f"1.96 * stddev_samp({ratio}) / sqrt(count(*)), quantile_cont({ratio}, 0.95) FROM rows "
        "GROUP BY ALL ORDER BY ALL"
    )
    names = ("errors", "noise", "declared_prior", "method", "trials", "ratio", "half_width_of_interval", "p95")
    write_table(options.out / "ratios.csv", [dict(zip(names, row, strict=True)) for row in table])
    return RunRecord(results.manifest.seed, results.manifest.trials)
