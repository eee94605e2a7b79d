"""The results of campaigns and recoveries as values: on named axes, through a pool of processes."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ltsim as lt
from ltsim.campaigns.statistics import CampaignStatistics
from ltsim.core.errors import InputError, ModelError
from ltsim.core.notation import number_text
from ltsim.reports.document_model import TableBlock
from ltsim.reports.figures.campaign import sweep_points
from ltsim.reports.figures.campaign_factors import cell_descriptions
from ltsim.reports.sections.campaign import campaign_section
from tests.families import family

SWEEP = {
    "scenario": "paper-workshop",
    "seed": 3,
    "trials": 24,
    "trials_per_shard": 24,
    "verified_trials_per_shard": 0,
    "statistics": ["errors"],
    "validation_points": "paper-laboratory",
    "methods": [{"method": "network"}, {"method": "distance"}],
}


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Any:
    link = {"angle_noise_arcsec": ["instrument.noise.azimuth_arcsec", "instrument.noise.elevation_arcsec"]}
    more = {"linked_keys": link, "grid": {"work.faces": [1, 2], "angle_noise_arcsec": [0.4, 0.8]}}
    return lt.campaign(SWEEP | more, out=tmp_path_factory.mktemp("sweep") / "rows")


def test_a_figure_without_arguments_is_drawn_for_a_grid_and_a_design(sweep: Any, tmp_path: Path) -> None:
    ranges = {"instrument.noise_factor": {"low": 0.5, "high": 2.0}}
    design = {"kind": "latin-hypercube", "cell_count": 3, "ranges": ranges}
    spread = lt.campaign(SWEEP | {"trials": 2, "trials_per_shard": 2, "design": design}, out=tmp_path / "rows")
    for results in (sweep, spread):
        assert results.plot().axes[0].lines


def test_a_sweep_is_a_dataset_with_units_on_axes_that_sel_takes(sweep: Any) -> None:
    pytest.importorskip("xarray", reason="the dataset is xarray's")
    cube = sweep.to_xarray("target_error_um", "share_removed")
    assert cube.sizes == {"calibrator": 2, "faces": 2, "angle_noise_arcsec": 2}
    selected = cube.sel(calibrator="distance", faces=2, angle_noise_arcsec=0.4)
    entry = next(s for s in sweep.statistic_summaries("target_error_um") if (s.cell, s.method) == (2, "distance"))
    assert sweep.levels[2] == {"faces": 2, "angle_noise_arcsec": 0.4}
    assert (float(selected.target_error_um), float(selected.target_error_um_low)) == (entry.mean, entry.low)
    assert cube.target_error_um.attrs["units"] == "um"
    assert cube.angle_noise_arcsec.attrs["units"] == "arcsec"
    assert "full_difference_sigma" not in sweep.to_xarray()
    with pytest.raises(ModelError, match="target_error_um"):
        sweep.to_xarray("target_eror_um")


def test_a_statistic_is_drawn_along_a_factor(sweep: Any) -> None:
    figure = sweep.plot("new_point_error_calibrated_um", "angle_noise_arcsec", panel="faces")
    assert [ax.get_title(loc="left") for ax in figure.axes] == ["faces 1", "faces 2"]
    assert figure.get_supxlabel() == "angle noise [arcsec]"
    assert "new point error" in figure.axes[0].get_ylabel()
    point = sweep_points(sweep, "target_error_um", "faces", angle_noise_arcsec=0.8, method="network")
    assert [(row.level, row.line_label) for row in point] == [(1, "network"), (2, "network")]
    with pytest.raises(ModelError, match="did you mean angle_noise_arcsec"):
        sweep.plot("target_error_um", "angle_noise_arcsecs")
    with pytest.raises(ModelError, match=r"several cells share a position on the axis.*faces"):
        sweep.plot("target_error_um", "angle_noise_arcsec")
    with pytest.raises(ModelError, match="give a factor of the campaign: faces or angle_noise_arcsec"):
        sweep.plot("target_error_um")
    with pytest.raises(ModelError, match="no level of faces called '3'; did you mean 1, 2"):
        sweep.plot("target_error_um", "angle_noise_arcsec", faces=3)


def test_a_statistic_of_a_function_has_the_interval_of_its_trials(sweep: Any) -> None:
    def mean(errors: np.ndarray) -> float:
        return float(errors.mean())

    entries, exact = sweep.bootstrap_statistic(mean, "target_error_um"), sweep.statistic_summaries("target_error_um")
    assert [(e.cell, e.method, e.column) for e in entries] == [(s.cell, s.method, "mean") for s in exact]
    for entry, spread in zip(entries, exact, strict=True):
        assert entry.mean == pytest.approx(spread.mean, rel=1e-6)
        assert entry.high - entry.low == pytest.approx(spread.high - spread.low, rel=0.35)
    both = sweep.bootstrap_statistic(lambda a, b: np.corrcoef(a, b)[0, 1], "target_error_um", "new_point_error_raw_um")
    assert all(-1 <= entry.low <= entry.mean <= entry.high <= 1 for entry in both)
    assert sweep.bootstrap_statistic(mean, "target_error_um") == entries
    with pytest.raises(ModelError, match="expected one number"):
        sweep.bootstrap_statistic(lambda errors: errors, "target_error_um")
    with pytest.raises(ModelError, match="ratio over all trials"):
        sweep.bootstrap_statistic(mean, "share_removed")


def test_a_folder_of_rows_is_opened_and_nothing_else(sweep: Any, tmp_path: Path) -> None:
    assert lt.read(sweep.folder) == sweep
    with pytest.raises(InputError, match=r"rows of a campaign; to run it, give .*campaign\.toml"):
        lt.campaign(sweep.folder, changes={"trials": 3})
    with pytest.raises(InputError, match=r"^the campaign: unknown key trialz; did you mean trials"):
        lt.campaign({"trialz": 3}, out=tmp_path / "rows")


def test_a_title_stands_for_the_tables_of_its_cell(tmp_path: Path) -> None:
    cells = [{"title": "all"}, {"title": "without S5", "stations.S5": "none"}]
    made = lt.campaign(SWEEP | {"cells": cells, "methods": [{}]}, out=tmp_path / "cells")
    assert [factor.name for factor in made.factors] == ["title"]
    assert cell_descriptions(made) == {0: "all", 1: "without S5"}


def test_an_axis_rises_however_the_sweep_has_grown(tmp_path: Path) -> None:
    pytest.importorskip("xarray", reason="the dataset is xarray's")
    made = lt.campaign(SWEEP | {"grid": {"work.targets": [8, 24, 16]}, "methods": [{}]}, out=tmp_path / "grown")
    cube = made.to_xarray("target_error_um")
    assert cube.targets.values.tolist() == [8, 16, 24]
    assert float(cube.target_error_um.sel(targets=24)[0]) == made.statistic_summaries("target_error_um")[1].mean


def test_cells_without_a_grid_lie_on_a_single_axis_and_no_name_is_an_argument_of_sel(tmp_path: Path) -> None:
    pytest.importorskip("xarray", reason="the dataset is xarray's")
    link = {"tolerance": ["instrument.noise_factor"]}
    cells = [{"tolerance": 1.0, "work.faces": 1}, {"tolerance": 2.0, "work.faces": 2}]
    made = lt.campaign(SWEEP | {"linked_keys": link, "cells": cells, "methods": [{}]}, out=tmp_path / "cells")
    cube = made.to_xarray("target_error_um")
    assert cube.sizes == {"calibrator": 1, "cell": 2}
    assert cube.sel(cell=1)["tolerance_"] == 2.0


def described(result: Any) -> tuple[str, list[str]]:
    """What a worker sees of a result."""
    return repr(result), result.to_dataframe().columns.to_list()


@pytest.mark.long
def test_results_go_through_a_pool_of_processes(sweep: Any) -> None:
    recording, _ = lt.simulate("paper-workshop", seed=3)
    calibration = lt.calibrate(recording)
    recovery = lt.recover("paper-workshop-re-aimed", trials=2)
    results = [calibration, lt.diagnose(recording, held_out=False), sweep, recovery]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        assert list(pool.map(described, results)) == [described(result) for result in results]
        (again,) = pool.map(lt.calibrate, [recording])
    assert np.array_equal(again.estimates, calibration.estimates)
    assert lt.campaign(sweep.folder) == sweep


def test_methods_are_compared_on_a_recording_as_the_campaign_compares_them_in_its_row(sweep: Any) -> None:
    changes = {"instrument.noise.azimuth_arcsec": 0.4, "instrument.noise.elevation_arcsec": 0.4, "work.faces": 1}
    scenario = lt.scenario("paper-workshop", changes)
    recording, _ = lt.simulate(scenario, seed=3, trial=17)
    calibrations = {method: lt.calibrate(recording, method=method) for method in ("network", "distance")}
    judged = lt.compare_calibrations(scenario, calibrations, "paper-laboratory", seed=3, trial=17).table()
    for kind in ("raw", "calibrated", "true_parameters"):
        sql = f"SELECT new_point_error_{kind}_um FROM rows WHERE cell = 0 AND trial = 17 ORDER BY method DESC"
        assert judged.column(f"error_{kind}_um") == pytest.approx([row[0] for row in sweep.query(sql)], rel=1e-4)
    assert judged.column("calibration") == ["network", "distance"]
    alone = lt.compare_calibrations(scenario, calibrations["network"], "paper-laboratory", seed=3, trial=17)
    assert alone.table().column("error_calibrated_um") == judged.column("error_calibrated_um")[:1]
    with pytest.raises(InputError, match="calibration 'network' is not from seed 3 and trial 16"):
        lt.compare_calibrations(scenario, calibrations, "paper-laboratory", seed=3, trial=16)
    with pytest.raises(InputError, match="no calibration is given"):
        lt.compare_calibrations(scenario, {}, "paper-laboratory", seed=3, trial=17)


def test_what_is_applied_is_judged_as_a_campaign_judges_it(tmp_path: Path) -> None:
    methods = [{"method": "network"}, {"name": "applied", "solver": "single", "uses_applied_corrections": True}]
    campaign = SWEEP | {"seed": 1, "trials": 2, "trials_per_shard": 2, "methods": methods}
    rows = lt.campaign(campaign, out=tmp_path / "rows")
    recording, _ = lt.simulate("paper-workshop", seed=1, trial=1)
    calibration = lt.calibrate(recording)
    assert not np.array_equal(calibration.applied_values, calibration.estimates)  # else both are one
    for method, applied in (("network", False), ("applied", True)):
        judged = lt.compare_calibrations(
            "paper-workshop", calibration, "paper-laboratory", uses_applied_corrections=applied, seed=1, trial=1
        )
        sql = f"SELECT new_point_error_calibrated_um FROM rows WHERE trial = 1 AND method = '{method}'"
        (row,) = rows.query(sql)
        assert judged.table().column("error_calibrated_um") == pytest.approx([row[0]], rel=1e-4)


def test_no_trials_and_no_workers_are_no_answer(tmp_path: Path) -> None:
    for trials in (0, -3):
        with pytest.raises(InputError, match=f"trials is {trials}, expected a whole number, 2 to 1,000,000,000"):
            lt.recover("paper-workshop", trials=trials)
    with pytest.raises(InputError, match="jobs is 0, expected a whole number, 1 to 256"):
        lt.campaign({"trials": 2}, out=tmp_path / "rows", jobs=0)
    with pytest.raises(ModelError, match="at least one noncentrality"):
        lt.injection_curve(lt.simulate("paper-workshop", seed=1).recording, "index-drift", strengths=[])


@pytest.mark.parametrize("kind", family([lt.calibrate, lt.adjust, lt.diagnose], 2))
def test_residuals_are_a_table(kind: Callable[..., Any]) -> None:
    recording, _ = lt.simulate("paper-workshop", seed=3)
    table = kind(recording).table("residuals")
    assert {"station", "target", "observable", "residual", "unit"} <= set(table.header)
    assert len(table.rows) == 3 * len(recording)


def test_the_page_has_the_noise_floor_next_to_each_error_and_says_what_its_statistics_are(sweep: Any) -> None:
    blocks = campaign_section(sweep.folder).blocks
    tables = {block.title: block for block in blocks if isinstance(block, TableBlock)}
    for title, prefix in (("Error of a point", ""), ("Error of a new point", "new_point_")):
        floors = [row[-2] for row in tables[title].rows]
        means = [number_text(s.mean) for s in sweep.statistic_summaries(f"{prefix}error_true_parameters_um")]
        assert [floor.partition(" ")[0] for floor in floors] == means
    (listed,) = (block for block in blocks if block.title == "Definitions of the statistics")
    meanings = listed.text.splitlines()
    assert len(meanings) == len([c for c in sweep.columns if ":" not in c])
    assert all(line.partition("]: ")[2] for line in meanings)


def test_the_page_tells_which_method_is_better_by_paired_differences(sweep: Any) -> None:
    section = campaign_section(sweep.folder)
    table = section.blocks[0]
    assert isinstance(table, TableBlock) and table.title == "Which method is better: error of a new point"
    statistic = "new_point_error_calibrated_um"
    by_method = {
        m: [s.mean for s in sweep.statistic_summaries(statistic) if s.method == m] for m in sweep.manifest.methods
    }
    best, other = sorted(by_method, key=lambda method: sum(by_method[method]))
    paired = sweep.paired_differences(statistic, method=(other, best)).entries
    names = cell_descriptions(sweep)
    for row, cell, entry in zip(table.rows, names, paired, strict=True):
        decided = f"{best} is better" if entry.low > 0 else f"{other} is better" if entry.high < 0 else "not decided"
        assert row[:2] == [names[cell], f"{other} minus {best}"] and row[-2:] == [decided, "24"]
        assert float(row[2]) == pytest.approx(entry.difference, rel=0.01)
    n_decided = sum(entry.low > 0 for entry in paired)
    assert f"the error of a new point with {best} is " in section.summary
    text = f" in {n_decided} of 4 combinations" if n_decided else "is not significantly different from"
    assert text in section.summary
    assert "true point" in table.note


def test_an_interruption_of_a_query_is_an_interruption(sweep: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    long = "SELECT count(*) FROM range(1000000) a, range(1000000) b WHERE a.range * b.range % 7 = 3"
    before = signal.signal(signal.SIGVTALRM, interrupt)
    monkeypatch.setattr(CampaignStatistics, "_summary_lines", lambda self: [str(self.query(long))])
    for work in (lambda: sweep.query(long), lambda: str(sweep)):
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.1)
        try:
            with pytest.raises(KeyboardInterrupt):
                work()
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    signal.signal(signal.SIGVTALRM, before)


def altered(sweep: Any, folder: Path, **changes: Any) -> Path:
    """A copy of a campaign with another manifest."""
    shutil.copytree(sweep.folder, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | changes))
    return folder


def test_a_manifest_that_does_not_belong_to_its_rows_is_refused(sweep: Any, tmp_path: Path) -> None:
    manifest = json.loads((sweep.folder / "manifest.json").read_text())
    cells, factors = manifest["cells"], manifest["factors"]
    wrong: dict[str, Any] = {
        "should have the number 0 and a level for each": {"cells": [cells[0] | {"levels": {}}, *cells[1:]]},
        "should have the number 1 and a level": {"cells": [cells[0], *cells[2:]]},
        "cells.0.levels.faces": {"cells": [cells[0] | {"levels": cells[0]["levels"] | {"faces": {}}}, *cells[1:]]},
        "cell 3 and method": {"cells": cells[:-1]},
        "and method distance, which are not in": {"methods": ["network"]},
        "the same name": {"methods": ["network", "network"]},
        "no key": {"factors": [factors[0] | {"keys": []}, *factors[1:]]},
        "names of statistics": {"settings": {"statistics": 3}},
    }
    for k, (says, changes) in enumerate(wrong.items()):
        with pytest.raises(InputError, match=says):
            lt.campaign(altered(sweep, tmp_path / str(k), **changes))


def test_names_in_a_campaign_folder_are_no_sql(sweep: Any, tmp_path: Path) -> None:
    folder, made = tmp_path / "sweep", tmp_path / "made"
    shutil.copytree(sweep.folder, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    name = manifest["factors"][0]["name"]
    hostile = f"{name}\" FROM rows; COPY (SELECT 1) TO '{made}'; --"
    text = (folder / "manifest.json").read_text().replace(f'"{name}"', json.dumps(hostile))
    (folder / "manifest.json").write_text(text)
    with pytest.raises(InputError, match="cannot be read"):
        lt.campaign(folder)
    assert not made.exists()
