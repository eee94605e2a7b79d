"""A cause put into a recording: what changes, what does not, what is told of it, and the curve."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment import adjust
from ltsim.campaigns.injection import _detection_curve_row
from ltsim.cli.main import run
from ltsim.core.errors import ModelError
from ltsim.geometry.polar import wrap_angle
from ltsim.physics.model.construction import declared_construction
from ltsim.recordings import Recording
from ltsim.simulation.injector import DetectionCurve

TWICE = {"work.faces": 2}


@pytest.fixture(scope="module")
def recording() -> Recording:
    return lt.simulate("paper-workshop", seed=7, changes=TWICE).recording


def change_of(before: Recording, after: Recording) -> np.ndarray:
    change = after.readings - before.readings
    change[:, 1:] = wrap_angle(change[:, 1:])
    return change


def test_nothing_else_is_changed(recording: Recording) -> None:
    made, truth = lt.inject(recording, "range-step:S3,range-step=30,time=0")
    change = change_of(recording, made)
    there = recording.station == recording.stations.index("S3")
    assert np.abs(change[there, 0] + 30e-6).max() < 1e-12  # a correction is truth less reading
    assert not change[~there].any() and not change[:, 1:].any()
    assert made.setup == recording.setup and np.array_equal(made.time, recording.time)
    (entry,) = truth.to_json()["injected"]
    assert entry["stations"] == ["S3"] and entry["parameters"] == [
        {"parameter": "range-step", "value": 30.0, "unit": "um"}
    ]


def test_it_is_what_the_simulator_does() -> None:
    """Simulated with the effect, or without it and injected: the same readings to 1 part in 1000 of the change."""
    entry = {"name": "station-weather", "stations": ["S2"], "values": {"station-weather": 9.0}}
    clean = lt.simulate("paper-workshop", seed=7, changes=TWICE).recording
    hidden = lt.simulate("paper-workshop", seed=7, changes=TWICE | {"effects": [entry]}).recording
    made, _ = lt.inject(clean, "station-weather:S2,station-weather=9")
    expected = change_of(clean, hidden)
    rounding = 0.1e-6
    assert np.abs(change_of(clean, made) - expected).max() < rounding + 1e-3 * np.abs(expected).max()
    assert np.abs(expected).max() > 10e-6


@pytest.mark.parametrize("cause", ["vertical-index:S2", "azimuth ~ sin(2 elevation)", "gauge-scale", "range-cyclic"])
def test_noncentrality_is_what_the_adjustment_leaves(recording: Recording, cause: str) -> None:
    """On readings without noise the chi-square grows by the noncentrality, with all that is known believed."""
    still = adjust(recording, declared_construction(recording))
    exact = recording.with_readings(still.problem.model.predict(still.state))
    made, truth = lt.inject(exact, cause, noncentrality=200.0, seed=3)
    before, after = (adjust(r, declared_construction(r), tested_reference_kinds=()).chi2 for r in (exact, made))
    assert truth.injected_effects[0].noncentrality == pytest.approx(200.0, rel=1e-3)
    assert after - before == pytest.approx(200.0, rel=0.03)


def test_noise_is_added_at_the_given_places(recording: Recording) -> None:
    made, truth = lt.inject(recording, "station-noise:S4", noncentrality=300.0, seed=1)
    change, there = change_of(recording, made), recording.station == recording.stations.index("S4")
    assert not change[~there].any()
    ratio = change[there] / recording.reading_sigmas()[there]
    assert np.mean(ratio**2) == pytest.approx(
        np.mean(truth.injected_effects[0].parameter_values), rel=0.4
    )  # added variance over stated
    assert truth.injected_effects[0].noncentrality == pytest.approx(300.0, rel=1e-3)


def test_a_swap_is_a_swap(recording: Recording) -> None:
    made, _ = lt.inject(recording, "target-swap:S1,T01,T09")
    a, b = (recording.targets.index(name) for name in ("T01", "T09"))
    rows = {
        t: np.flatnonzero((recording.station == 0) & (recording.target == t) & (recording.face == 1))[0] for t in (a, b)
    }
    gap = made.readings[rows[a]] - recording.readings[rows[b]]
    assert np.abs([gap[0], *wrap_angle(gap[1:])]).max() < 60e-6
    assert np.abs(change_of(recording, made)[recording.station != 0]).max() < 1e-12


@pytest.mark.long
def test_injected_effects_are_detected(recording: Recording) -> None:
    made, truth = lt.inject(recording, "target-moved", noncentrality=400.0, seed=2)
    diagnosis = lt.diagnose(made, held_out=False)
    assert diagnosis.verdict == "mismatch"
    assert list(diagnosis.findings[0].where.targets) == truth.to_json()["injected"][0]["targets"]


def test_unspecified_places_are_drawn_where_the_effect_is_detectable(recording: Recording) -> None:
    """The moment of a bump at a station that is named lies within its visit."""
    _, truth = lt.inject(recording, "station-bump:S2", noncentrality=200.0, seed=3)
    there = recording.time[recording.station == recording.stations.index("S2")]
    assert there.min() < truth.injected_effects[0].to_json()["shape"]["time"] < there.max()


def test_a_row_of_the_curve_has_the_columns_of_its_table() -> None:
    cause = SimpleNamespace(largest_changes={"distance_um": 20.0, "azimuth_urad": 3.0, "elevation_urad": 5.0})
    outcome = {"detections": True, "placed": True, "named": False, "right": False}
    curve = DetectionCurve("range-step", (), (_detection_curve_row(25.0, [cause], [outcome] * 4),))
    (row,) = curve.table().json_rows()
    assert (row["largest_urad"], row["placed"], row["named"], row["named_low"]) == (5.0, 4, 0, 0.0)


@pytest.mark.long
def test_the_curve_rises(recording: Recording) -> None:
    curve = lt.injection_curve(recording, "range-step:S3", strengths=(2.0, 300.0), injections=2, seed=1)
    weak, strong = curve.table().json_rows()
    assert strong["detections"] == strong["placed"] == 2 > weak["detections"]
    assert strong["largest_um"] > 5 * weak["largest_um"]
    assert 0.0 <= strong["detections_low"] < 1.0 == strong["detections_high"]


@pytest.mark.parametrize(
    ("cause", "message"),
    [
        ("nonsense", "no effect called 'nonsense'"),
        ("range-step:S9", "'S9' is not a station"),
        ("range-step:S3,range-step=far", "expected a number"),
        ("azimuth ~ nothing at all", "nothing at all"),
        ("azimuth ~ constant:S2", "network absorbs"),
        ("target-swap", "no parameter to scale"),
    ],
)
def test_impossible_causes_are_refused(recording: Recording, cause: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        lt.inject(recording, cause, noncentrality=1e9)


def test_what_happens_after_the_last_pointing_changes_nothing_and_is_refused(recording: Recording) -> None:
    with pytest.raises(ModelError, match="target-moved:T05,time=1e6 changes no reading; give measured"):
        lt.inject(recording, "target-moved:T05,time=1e6")


def test_the_command_writes_the_truth_to_a_separate_file(tmp_path: Path, recording: Recording) -> None:
    lt.write(recording, tmp_path / "rec")
    words = ["inject", str(tmp_path / "rec"), "range-step:S3", "--noncentrality", "100", "--quiet"]
    assert run([*words, "--out", str(tmp_path / "made"), "--truth", str(tmp_path / "truth.json")]) == 0
    truth = json.loads((tmp_path / "truth.json").read_text())
    assert truth["format"] == "ltsim-injection/1" and truth["injected"][0]["effect"] == "range-step"
    change = change_of(lt.read(tmp_path / "rec"), lt.read(tmp_path / "made"))
    assert np.abs(change[:, 0]).max() == pytest.approx(1e-6 * truth["injected"][0]["largest"]["distance_um"], rel=1e-4)
    assert sorted(f.name for f in (tmp_path / "made").iterdir()) == ["observations.csv", "setup.toml"]
    assert run([*words]) == 2
    assert run(["inject", str(tmp_path / "rec"), "range-step:S9", "--out", str(tmp_path / "no")]) == 2
    assert not (tmp_path / "no").exists()


def test_an_effect_with_its_size_is_injected_as_in_words(recording: Recording) -> None:
    words = lt.inject(recording, "range-step:S3,range-step=30", seed=1)
    made = lt.inject(recording, lt.Effect("range-step", stations="S3", range_step=30), seed=1)
    np.testing.assert_array_equal(made.recording.readings, words.recording.readings)
    with pytest.raises(ModelError, match="the effect range-step has a size, but sizes are estimated here"):
        lt.calibrate(recording, with_effects=lt.Effect("range-step", range_step=30))


def test_a_list_of_causes_is_refused_in_a_sentence() -> None:
    recording, _ = lt.simulate("paper-workshop", seed=7)
    with pytest.raises(ModelError, match="separate arguments"):
        lt.inject(recording, ["index-drift"])  # type: ignore[arg-type]
