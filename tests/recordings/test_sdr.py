"""Sokkia SDR20 and SDR33: widths, units, orders, faces, heights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import RecordError
from ltsim.core.units import DEGREE
from ltsim.recordings import read

NAME, NUMBER = {"20": 4, "33": 16}, {"20": 10, "33": 16}


def record(dialect: str, kind: str, names: list[str], numbers: list[float]) -> str:
    cells = [f"{name:>{NAME[dialect]}}" for name in names]
    return kind + "".join(cells) + "".join(f"{x:<{NUMBER[dialect]}.{4 if dialect == '20' else 8}f}" for x in numbers)


def book(dialect: str, *, units: str = "111111", zero: str = "1", unit: float = 1.0) -> list[str]:
    """Two stations that see each other and a third point, the first on both faces; angles in `unit` degrees."""

    def angles(zenith: float, turn: float) -> list[float]:
        return [(90.0 - zenith if zero == "2" else zenith) / unit, turn / unit]

    north, east = (500.0, 100.0) if units[4] == "1" else (100.0, 500.0)
    version = "SDR20V03-05" if dialect == "20" else "SDR33V04-01"
    return [
        f"00NM{version:16}0000{'26-Nov-26 08:00':16}{units}",
        f"01KI1{'TS':16}{'000001':6}{'TS':16}{'000001':6}1{zero}0.000     0.000     0.000     ",
        record(dialect, "02TP", ["1"], [north, east, 20.0, 1.5]),
        record(dialect, "03NM", [], [1.6]),
        record(dialect, "09F1", ["1", "2"], [30.25, *angles(88.5, 12.25)]),
        record(dialect, "09F2", ["1", "2"], [30.25, *angles(271.5, 192.25)]),
        record(dialect, "09F1", ["1", "7"], [12.125, *angles(95.25, 300.5)]),
        record(dialect, "09MC", ["1", "7"], [12.125, *angles(95.25, 300.5)]),
        record(dialect, "02TP", ["2"], [north + 30.0, east, 20.5, 1.4]),
        record(dialect, "03NM", [], [1.7]),
        record(dialect, "09F1", ["2", "1"], [30.25, *angles(91.5, 192.25)]),
    ]


def written(path: Path, lines: list[str]) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("dialect", ["20", "33"])
@pytest.mark.parametrize(("units", "unit"), [("111111", 1.0), ("211121", 0.9)])
def test_both_dialects_and_their_units(tmp_path: Path, dialect: str, units: str, unit: float) -> None:
    recording = read(written(tmp_path / "a.sdr", book(dialect, units=units, unit=unit)))
    assert recording.stations == ("1", "2") and recording.targets == ("2", "7", "1")
    assert list(recording.face) == [1, 2, 1, 1]
    digits = 1e-4 * DEGREE if dialect == "20" else 1e-8
    np.testing.assert_allclose(recording.readings[0], [30.25, (360 - 12.25) * DEGREE, 1.5 * DEGREE], atol=digits)
    np.testing.assert_allclose(recording.readings[1, 1:], [(360 - 192.25) * DEGREE, 178.5 * DEGREE], atol=digits)
    first, second = (recording.station_setup(name) for name in ("1", "2"))
    assert first.position_mm == pytest.approx((100_000.0, 500_000.0, 20_000.0))
    assert first.levelled and first.over == "1" and second.instrument_height_mm == pytest.approx(1400.0)
    np.testing.assert_allclose(recording.heights_above_marks()[1], [1.6, 1.6, 1.6, 1.7])
    assert "because it is an SDR file" in recording.notes[0]
    assert any("1 observations that the instrument corrected" in note for note in recording.notes)


def test_angles_from_the_horizon_and_feet(tmp_path: Path) -> None:
    lines = book("33", units="121111", zero="2")
    recording = read(written(tmp_path / "a.sdr", [line for line in lines if not line.startswith("09F2")]))
    np.testing.assert_allclose(recording.readings[0, [0, 2]], [30.25 * 0.3048, 1.5 * DEGREE])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda lines: [lines[0][:40] + "3" + lines[0][41:], *lines[1:]],
            "row 1: found the unit '3' of angles, expected one of",
        ),
        (lambda lines: [*lines[:2], *lines[4:]], "row 3: this measurement is before the first station"),
        (lambda lines: [*lines[:4], lines[-1]], "names the station '2', expected the station of the last record 02"),
        (lambda lines: [*lines[:4], lines[4].replace("30.25", "30,2x")], "row 5: found '30,2x"),
        (lambda lines: lines[:4], "contains no measurements"),
    ],
)
def test_wrong_files_are_refused_in_a_sentence(tmp_path: Path, change: object, says: str) -> None:
    with pytest.raises(RecordError) as refused:
        read(written(tmp_path / "a.sdr", change(book("33"))))  # type: ignore[operator]
    assert says in str(refused.value)


def test_elevations_from_the_horizon_may_count_round_the_circle(tmp_path: Path) -> None:
    lines = book("33", zero="2")
    lines = [line.replace("-5.25000000", "354.75000000") for line in lines]
    assert any("354.75000000" in line for line in lines)
    expected = read(written(tmp_path / "a.sdr", book("33", zero="2")))
    np.testing.assert_allclose(read(written(tmp_path / "b.sdr", lines)).readings, expected.readings, atol=1e-12)


def test_corrected_observations_alone_are_refused_with_what_to_export(tmp_path: Path) -> None:
    lines = [line for line in book("33") if not line.startswith("09F")]
    with pytest.raises(RecordError, match=r"1 observations that the instrument corrected.*09F1, 09F2"):
        read(written(tmp_path / "a.sdr", lines))


def test_a_last_observation_that_is_cut_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.sdr"
    file.write_text("\n".join(book("33")).rstrip()[:-20])
    with pytest.raises(RecordError, match="row 11: the last line has no line break and is incomplete"):
        read(file)


@pytest.mark.parametrize("suffix", ["txt", "csv", "dat"])
def test_the_header_decides_and_not_the_suffix(tmp_path: Path, suffix: str) -> None:
    assert read(written(tmp_path / f"a.{suffix}", book("33"))).stations == ("1", "2")


def test_a_set_up_and_a_target_of_another_spelling_are_the_same_mark(tmp_path: Path) -> None:
    stations = slice(4, 20)
    lines = book("33")
    for i, line in enumerate(lines):
        if line[:2] in ("02", "09"):
            lines[i] = line[:4] + line[stations].strip().zfill(4).rjust(16) + line[20:]
    recording = read(written(tmp_path / "a.sdr", lines))
    assert recording.stations == ("0001", "0002") and recording.targets == ("2", "7", "1")
    assert [recording.station_setup(name).over for name in recording.stations] == ["1", "2"]
    assert any("are one mark: '0001' and '1', '0002' and '2'" in note for note in recording.notes)
