"""Every real recording beside the project goes through the verbs without a fault: an answer, or one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from ltsim.cli.main import run

SMALL = {
    "levelled trackers": ("cern-lgc-trackers/Title-Example-SIMULATED.lgc2", ()),
    "free stations": ("cern-lgc-trackers/totalStationConvergence.lgc", ()),
    "a girder": ("desy-girder-at960/Polar_measurements_22Sep21.txt", ("--hint", "azimuth=clockwise")),
    "one station": ("format-samples/sa_instrument_report_single_station.csv", ()),
    "a bundle": ("format-samples/openindy_example_1.xml", ()),
    "a quarry": ("gama-3d-networks/2019-prager.gkf", ()),
    "a dam": ("gama-3d-networks/2020-barta-phase_0-1TK.gkf", ()),
    "a yard": ("gama-3d-networks/local_3d.gkf", ()),
    "a table": ("tables/02-german.csv", ()),
}
LARGE = {
    "many set-ups": ("cern-lgc-trackers/20697_V2_Dirk_ESA_experimental.lgc", ()),
    "an arc": ("cern-lgc-trackers/Arc_2_3.lgc", ()),
    "a report": ("desy-girder-at960/SA_CompositeReport_20Sep21.csv", ()),
    "seven sets": ("geoeasy-total-station-22st/network.GSI", ()),
}


def goes_through(shared: Path, folder: Path, file: str, options: tuple[str, ...]) -> None:
    recording = str(shared / "recordings" / file)
    statuses = {
        verb: run([verb, recording, *options, "--quiet", "--out", str(folder / verb)])
        for verb in ("adjust", "calibrate", "check", "diagnose")
    }
    assert statuses["adjust"] == statuses["calibrate"] == statuses["diagnose"] == 0
    assert statuses["check"] in (0, 1, 2)  # go, no-go, nothing was measured twice
    assert run(["report", str(folder), "--quiet"]) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", SMALL)
def test_small_recordings(shared: Path, tmp_path: Path, name: str) -> None:
    goes_through(shared, tmp_path, *SMALL[name])


@pytest.mark.long
@pytest.mark.parametrize("name", LARGE)
def test_large_recordings(shared: Path, tmp_path: Path, name: str) -> None:
    """Their pages are light enough to be sent: 3,365 diagnosed pointings of the arc take less than 8 MB.

    With every verb's results and the recording itself in one folder too.
    """
    file, options = LARGE[name]
    converted = [str(shared / "recordings" / file), str(tmp_path / "recording"), *options]
    assert run(["convert", *converted, "--quiet"]) == 0
    goes_through(shared, tmp_path, file, options)
    assert (tmp_path / "report.html").stat().st_size < 8e6
    assert run(["report", str(tmp_path / "diagnose"), "--quiet"]) == 0
    assert (tmp_path / "diagnose" / "report.html").stat().st_size < 8e6
