"""Point errors by ranges from several stations, and by ranges and angles, at equal numbers of pointings."""

from experiments.common import Options, RunRecord, campaign, show_table


def run(options: Options) -> RunRecord:
    results = campaign("config.toml", options)
    errors = {
        s.cell: {"mean_um": s.mean, "low_um": s.low, "high_um": s.high}
        for s in results.statistic_summaries("target_error_um")
    }
    cells = [{"way": level["title"], "constants": "drawn" if level["draw"] else "none"} for level in results.levels]
    show_table(options.out / "multilateration.csv", [cell | errors[k] for k, cell in enumerate(cells)])
    return RunRecord(results.manifest.seed, results.manifest.trials)
