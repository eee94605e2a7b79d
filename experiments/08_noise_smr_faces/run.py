"""Effect of noise, faces and reflectors on a calibration, evaluated at held-out points."""

from experiments.common import ERROR, NEW_POINTS, Made, Options, campaign, write_figure, write_pairs
from ltsim.reports.figures.campaign import sweep_panels_figure, sweep_points

AXIS = "true noise over that of the specification"


def run(given: Options) -> Made:
    results = campaign("config.toml", given)
    for faces in (1, 2):
        rows = sweep_points(results, ERROR, "noise_factor", panel="title", faces=faces)
        write_figure(
            given.out / f"faces-{faces}.svg", sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title=AXIS)
        )
    pairs = (
        results.paired_differences(ERROR, faces=(2, 1)),
        results.paired_differences(ERROR, method=("network", "distance")),
    )
    write_pairs(given.out / "paired.csv", *pairs)
    return Made(results.manifest.seed, results.manifest.trials)
