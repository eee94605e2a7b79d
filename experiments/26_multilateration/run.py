"""Point errors by ranges from several stations, and by ranges and angles, at equal numbers of pointings."""

from experiments.common import Made, Options, campaign, show_table


def run(given: Options) -> Made:
    results = campaign("config.toml", given)
    shown = {
        s.cell: {"mean_um": s.mean, "low_um": s.low, "high_um": s.high}
        for s in results.statistic_summaries("target_error_um")
    }
    cells = [{"way": level["title"], "constants": "drawn" if level["draw"] else "none"} for level in results.levels]
    show_table(given.out / "multilateration.csv", [cell | shown[k] for k, cell in enumerate(cells)])
    return Made(results.manifest.seed, results.manifest.trials)
