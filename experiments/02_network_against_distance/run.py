"""Comparison of the paper's method with the network adjustment on the same trials, by errors of new points."""

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, campaign, write_figure, write_paired_differences
from ltsim.reports.figures.campaign import sweep_panels_figure, sweep_points

AXIS = "declared prior over the true one"


def run(options: Options) -> RunRecord:
    results = campaign("config.toml", options)
    write_figure(
        options.out / "new_points.svg",
        sweep_panels_figure(
            sweep_points(results, ERROR, "prior_factor", panel="title"), statistic_title=NEW_POINTS, x_title=AXIS
        ),
    )
    shown = sweep_points(results, "distance_improvement_percent", "prior_factor", panel="title")
    label = "improvement shown [%]"
    write_figure(options.out / "criterion.svg", sweep_panels_figure(shown, statistic_title=label, x_title=AXIS))
    # Both methods use the same draws and the same prior, so their difference has a smaller uncertainty than each mean.
    rivals = [name for name in results.manifest.methods if name != "network"]
    write_paired_differences(
        options.out / "paired.csv", *(results.paired_differences(ERROR, method=(name, "network")) for name in rivals)
    )
    return RunRecord(results.manifest.seed, results.manifest.trials)
