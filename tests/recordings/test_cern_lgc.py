"""CERN's LGC: points, instruments, set-ups, observations, what is switched off, what is skipped."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.core.units import GON
from ltsim.geometry.polar import from_polar
from ltsim.geometry.rigid import align_rigidly
from ltsim.recordings import Recording, read
from tests.recordings.samples import outcome, shared

SAMPLE = """*TITR
Réseau d'essai
*RS2K
*PREC 6
*INSTR
*POLAR AT402.1 PRISM 0.2 0 0 0 0
PRISM 3 4 .02 6 0 0 0 0 0.03 0
BALL 5 5 .01 0 0 0 0 0 0.03 0
*PDOR
HALL.P2.
*CALA
HALL.P1.   2000.0 3000.0 400.0   $12 comment
*VXY
HALL.P3.   2010.0 3005.0 401.0
*POIN
HALL.P2.   2020.0 3000.0 400.5
HALL.P4.   0 0 400
HALL.S1.   2005.0 3002.0 401.5
HALL.S2.   2015.0 3003.0 401.5
%HALL.P9.   1.000 2.000 3.000
*TSTN HALL.S1. AT402.1 IHFIX IH 0.1 %station one
*V0
*ANGL
HALL.P1. 100.5 OBSE 2
HALL.P2. 300.25
%HALL.P3. 20.1234 OBSE 2
HALL.P1. 100.6 OBSE 2
*ZEND
HALL.P1. 101.0 OBSE 2 TH 0.07
HALL.P2. 99.0
HALL.P1. 101.1 OBSE 2 TH 0.07
*DIST
HALL.P1. 5.5 OBSE .015 PPM 0 TH 0.07
HALL.P2. 15.25 TRGT BALL
HALL.P1. 5.6 OBSE .015 PPM 0 TH 0.07
*TSTN HALL.S2. AT402.1 ROT3D
*V0 ACST 10
*PLR3D
HALL.P1. 10 100 15.0 ASE 7 ZSE 8 DSE .5
HALL.P3. 20 90 6.0
HALL.P4. 30 95 8.0
*V0
*DHOR
HALL.P2. 5.0
*DVER
HALL.P1. HALL.P2. 0.5
*FRAME F 0 0 0 0 0 0 1
*OBSXYZ
HALL.P1. 1 2 3 1 1 1
*ENDFRAME
*END
"""


def sample(path: Path, old: str = "", new: str = "") -> Path:
    assert old in SAMPLE
    text = SAMPLE.replace(old, new, 1) if old else SAMPLE
    path.write_bytes(text.encode("latin-1"))
    return path


def test_a_file_is_understood(tmp_path: Path) -> None:
    recording = read(sample(tmp_path / "a.lgc"))
    assert recording.stations == ("HALL.S1.", "HALL.S2.", "HALL.S2.#2")
    assert recording.setup.title == "Réseau d'essai"
    readings, sigma = recording.readings, recording.reading_sigmas()
    np.testing.assert_allclose(readings[0], [5.5, (400 - 100.5) * GON, -1.0 * GON])
    np.testing.assert_allclose(readings[1], [15.25, (400 - 300.25) * GON, 1.0 * GON])
    np.testing.assert_allclose(readings[2], [5.6, (400 - 100.6) * GON, -1.1 * GON])
    np.testing.assert_allclose(sigma[0], [15e-6, 2e-4 * GON, 2e-4 * GON])
    np.testing.assert_allclose(sigma[1], [10e-6, 3e-4 * GON, 4e-4 * GON])
    np.testing.assert_allclose(readings[3], [15.0, (400 - 20) * GON, 0], atol=1e-12)
    np.testing.assert_allclose(sigma[3], [0.5e-3 + 6e-6 * 15, 7e-4 * GON, 8e-4 * GON])
    np.testing.assert_allclose(sigma[4, 0], 0.02e-3 + 6e-6 * 6.0)
    assert recording.is_horizontal_distance[-1]
    instrument, target = recording.heights_above_marks()
    np.testing.assert_allclose(instrument, [0.1] * 3 + [0] * 4)
    np.testing.assert_allclose(target, [0.07, 0.03, 0.07, 0.03, 0.03, 0.03, 0.03])


def test_setups_points_and_notes(tmp_path: Path) -> None:
    recording = read(sample(tmp_path / "a.lgc"))
    stations, targets = recording.setup.stations, recording.setup.targets
    assert stations["HALL.S1."].levelled
    assert stations["HALL.S1."].levelling_sigma_arcsec == 1e-3
    assert not stations["HALL.S2."].levelled
    assert stations["HALL.S1."].over is None
    vertical = stations["HALL.S1."].vertical
    assert vertical is not None
    assert abs(vertical[0]) < 3e-6
    assert targets["HALL.P1."].known_axes == "xyz"
    assert targets["HALL.P3."].known_axes == "z"
    assert targets["HALL.P2."].datum
    assert targets["HALL.P4."].approximate_mm is None
    notes = " ".join(recording.notes)
    for note in (
        "2 lines are switched off",
        "*DVER is not supported: 1 lines are skipped",
        "*OBSXYZ observes 1 points in a separate frame (F): they are not used, because all of them are fixed",
        "*RS2K",
    ):
        assert note in notes, note


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("*END\n", "", "without *END and is incomplete"),
        ("*TSTN HALL.S1. AT402.1", "*TSTN HALL.S1. AT999.9", "that *POLAR declares"),
        ("*TSTN HALL.S1.", "*TSTN HALL.S9.", "no block of points declares"),
        ("HALL.P1. 100.5", "HALL.PX. 100.5", "in no block of points"),
        ("HALL.P1. 100.5", "HALL.P1. abc", "expected a number"),
        ("HALL.P1. 100.5 OBSE 2", "HALL.P1. 100.5 OBSE", "the option OBSE has no value"),
        ("HALL.P1. 100.5 OBSE 2", "HALL.P1. 100.5 OBSE 0", "standard deviation is 0"),
        ("HALL.P1. 101.0", "HALL.P1. 301.0", "zenith angle of 301"),
        ("HALL.P1. 5.5", "HALL.P1. -5.5", "distance of -5.5"),
        ("HALL.P1. 5.5", "HALL.P1. 1e300", "at most"),
        ("TRGT BALL", "TRGT CUBE", "not declared with instrument"),
        ("HALL.P1.   2000.0 3000.0", "HALL.P2.   2000.0 3000.0", "declared twice"),
        ("HALL.P2.   2020.0 3000.0 400.5", "HALL.P2.   2020.0", "three coordinates"),
        ("HALL.P4.   0 0 400", "<b>   0 0 400", "holds '<'"),
        ("BALL 5 5 .01 0 0 0 0 0 0.03 0", "BALL 5 5", "standard deviations"),
        ("PRISM 3 4 .02 6", "PRISM 3e11 4 .02 6", "a.lgc: azimuth_arcsec is 9"),
        ("Réseau", "x" * 30_000, "longer than"),
    ],
)
def test_wrong_files(tmp_path: Path, old: str, new: str, says: str) -> None:
    result = outcome(lambda: read(sample(tmp_path / "a.lgc", old, new)))
    assert isinstance(result, str)
    assert says in result


def test_a_cut_file(tmp_path: Path) -> None:
    content = sample(tmp_path / "a.lgc").read_bytes()
    for cut in range(0, len(content) - 5, 3):
        (tmp_path / "a.lgc").write_bytes(content[:cut])
        assert isinstance(outcome(lambda: read(tmp_path / "a.lgc", format="cern-lgc")), str)


def misfit(recording: Recording, side: float) -> list[float]:
    """How far the targets of each station are from the coordinates in the file [m], azimuth one way or the other."""
    local = from_polar(recording.readings) * [1.0, side, 1.0]
    setups = [recording.target_setup(t) for t in recording.targets]
    points = np.array([t.known_mm or t.approximate_mm or (np.nan,) * 3 for t in setups])[recording.target] / 1e3
    misfits = []
    for s in range(len(recording.stations)):
        rows = (recording.station == s) & np.isfinite(local).all(axis=1) & np.isfinite(points).all(axis=1)
        if rows.sum() > 5:
            rotation, shift = align_rigidly(local[rows], points[rows])
            misfits.append(float(np.median(np.linalg.norm(local[rows] @ rotation.T + shift - points[rows], axis=1))))
    return misfits


@pytest.mark.parametrize(
    ("name", "stations", "targets", "pointings"),
    [("20697_V2_Dirk_ESA_experimental.lgc", 23, 107, 363), ("Arc_2_3.lgc", 54, 1003, 3365)],
)
def test_real_files(name: str, stations: int, targets: int, pointings: int) -> None:
    file = shared("recordings", "cern-lgc-trackers", name)
    if not file.exists():
        pytest.skip("CERN's recordings are not beside this checkout")
    recording = read(file)
    assert (len(recording.stations), len(recording.targets), len(recording)) == (stations, targets, pointings)
    right, wrong = misfit(recording, 1.0), misfit(recording, -1.0)
    assert np.median(right) < 0.3 * np.median(wrong)


PLACED = """*TITR
Observed points
*OLOC
*INSTR
*POLAR AT402.391234 PRISM 0 0 0 0 0
PRISM 3 4 .02 6 0 0 0 0 0 0
*CALA
FIXED 0 0 0
*POIN
SEEN 10 0 1
HALF 0 10 1 SX 0 SZ 2
WHOLE 10 10 1 APRICOV MAT(4e-6,1e-6,0,1e-6,9e-6,0,0,0,1e-6)
ST 4 4 2
*TSTN ST AT402.391234 ROT3D
*V0
*PLR3D
FIXED 250 120 6
SEEN 350 110 7.3
HALF 150 110 7.3
WHOLE 50 110 8.5
*OBSXYZ
FIXED 1 1 1 1 1 1
SEEN 10.001 0.002 1.003 1 2 3
SEEN 10.003 0.002 1.003 1 2 3
*END
"""


def test_observed_coordinates_have_their_covariance(tmp_path: Path) -> None:
    file = tmp_path / "a.lgc"
    file.write_text(PLACED)
    recording = read(file)
    targets = recording.setup.targets
    assert (targets["FIXED"].known_mm, targets["FIXED"].known_covariance_mm2) == ((0, 0, 0), None)
    assert "the coordinates of FIXED in *OBSXYZ are not used" in " ".join(recording.notes)
    np.testing.assert_allclose(targets["SEEN"].known_mm, [10002, 2, 1003])
    np.testing.assert_allclose(targets["SEEN"].known_covariance_mm2, [0.5, 0, 0, 2, 0, 4.5], atol=1e-9)
    half = targets["HALF"]
    assert half.known_axes == "xz"
    assert half.approximate_mm == (0, 10000, 1000)
    assert half.known_covariance_mm2 is not None
    np.testing.assert_allclose(np.array(half.known_covariance_mm2)[[0, 5]], [1e-8, 4])
    np.testing.assert_allclose(targets["WHOLE"].known_covariance_mm2, [4, 1, 0, 9, 0, 1], atol=1e-9)
    tracker = recording.setup.instruments["AT402.391234"]
    assert (tracker.model, tracker.serial) == ("AT402", "391234")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("SX 0 SZ 2", "BEAR 10 SX 1", "which is not supported; use APRICOV"),
        ("MAT(4e-6,1e-6,0,1e-6,9e-6,0,0,0,1e-6)", "DIAG(1,2)", "expected DIAG"),
        ("MAT(4e-6,1e-6,0", "MAT(4e-6,2e-6,0", "expected DIAG"),
        ("SEEN 10.001 0.002 1.003 1 2 3", "SEEN 10.001 0.002 1.003 1 2", "three standard deviations"),
        ("SEEN 10.001 0.002 1.003 1 2 3", "SEEN 10.001 0.002 1.003 1 0 3", "has a standard deviation of 0"),
        ("SEEN 10.001", "NOBODY 10.001", "observes NOBODY, which is in no block of points"),
    ],
)
def test_wrong_covariances_get_a_sentence(old: str, new: str, words: str, tmp_path: Path) -> None:
    assert old in PLACED
    file = tmp_path / "a.lgc"
    file.write_text(PLACED.replace(old, new, 1))
    with pytest.raises(RecordError, match=words):
        read(file)
