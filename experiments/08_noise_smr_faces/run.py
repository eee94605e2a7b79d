"""Effect of noise, faces and reflectors on a calibration, evaluated at held-out points."""

from experiments.common import ERROR, NEW_POINTS, Options, RunRecord, campaign, write_figure, write_paired_differences
from ltsim.reports.figures.campaign import sweep_panels_figure, sweep_points

AXIS = "true noise over that of the specification"


def run(options: Options) -> RunRecord:
    results = campaign("config.toml", options)
    for faces in (1, 2):
        rows = sweep_points(results, ERROR, "noise_factor", panel="title", faces=faces)
        write_figure(
            options.out / f"faces-{faces}.svg", sweep_panels_figure(rows, statistic_title=NEW_POINTS, x_title=AXIS)
        )
    pairs = (
        results.paired_differences(ERROR, faces=(2, 1)),
        results.paired_differences(ERROR, method=("network", "distance")),
    )
    write_paired_differences(options.out / "paired.csv", *pairs)
    return RunRecord(results.manifest.seed, results.manifest.trials)
