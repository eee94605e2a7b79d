"""Comparison of the paper's method with the network adjustment on the same trials, by errors of new points."""

from experiments.common import ERROR, NEW_POINTS, Made, Options, campaign, write_figure, write_pairs
from ltsim.reports.figures.campaign import sweep_panels_figure, sweep_points

AXIS = "stated prior over the true one"


def run(given: Options) -> Made:
    results = campaign("config.toml", given)
    write_figure(
        given.out / "new_points.svg",
        sweep_panels_figure(
            sweep_points(results, ERROR, "prior_factor", panel="title"), statistic_title=NEW_POINTS, x_title=AXIS
        ),
    )
    shown = sweep_points(results, "distance_improvement_percent", "prior_factor", panel="title")
    label = "improvement shown [%]"
    write_figure(given.out / "criterion.svg", sweep_panels_figure(shown, statistic_title=label, x_title=AXIS))
    # The same draws by both methods, with one prior: differences are known better than either mean.
    rivals = [name for name in results.manifest.methods if name != "network"]
    write_pairs(
        given.out / "paired.csv", *(results.paired_differences(ERROR, method=(name, "network")) for name in rivals)
    )
    return Made(results.manifest.seed, results.manifest.trials)
