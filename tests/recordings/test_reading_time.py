"""Small files whose reading took minutes or hours: patterns that try every division, and searches in growing lists."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from ltsim.core.errors import LtsimError, RecordError
from ltsim.core.limits import MAX_LGC_LINES, MAX_TOML_KEYS
from ltsim.core.units import parse_quantity_in_unit
from ltsim.recordings import Hints, read
from ltsim.recordings.exchange import MAX_FORMAT_RECOGNITION_BYTES, MAX_NOTES_PER_FILE
from ltsim.recordings.files import SourceLocation
from ltsim.recordings.formats import field_book
from ltsim.recordings.formats.field_book import FieldBook
from ltsim.recordings.settings import setup_to_toml, validate_setup

N_SETUPS = 20_000
"""Number of set-ups of a file; the square of it is a minute of comparisons."""


@contextmanager
def processor_time_below(seconds: float) -> Iterator[None]:
    """Context that asserts the processor time [s] of its work."""
    before = os.times().user
    yield
    assert os.times().user - before < seconds


def sentence_of(file: Path) -> str:
    """Sentence with which a file is refused; empty for a file that is read."""
    try:
        read(file)
    except LtsimError as problem:
        return str(problem)
    return ""


@pytest.mark.parametrize(
    ("start", "repeated"),
    [
        ("", "<!--a-->"),
        ("<?xml version='1.0'?>", "<!--a-->\n"),
        ("M ", "-"),
        ("M A", "-B"),
        ("DB A", "\n"),
        ("JOB", "\n"),
        ("CO,", "\n"),
        ("{1", " "),
        ("", "\n"),
        ("", " \n"),
        ("", "#\n"),
    ],
)
def test_the_format_of_a_file_is_recognised_in_no_time(start: str, repeated: str, tmp_path: Path) -> None:
    """Thirty comments before an element took hours, and 16,000 hyphens after an M as well."""
    file = tmp_path / "a.txt"
    file.write_text(start + repeated * (MAX_FORMAT_RECOGNITION_BYTES // len(repeated)) + "x\n")
    with processor_time_below(3), pytest.raises(RecordError):
        read(file)


TABLE = "station,target,Hz[deg],zenith[deg],distance[mm]\nS1,T1,10,80,3000\n"


@pytest.mark.parametrize("line", ["#{}x", "a:b{}x", "station{}x", "x{}1{}x"])
@pytest.mark.parametrize("separators", [" ", ";"])
def test_lines_between_the_rows_of_a_table_take_no_time(line: str, separators: str, tmp_path: Path) -> None:
    """A file of 60,000 such lines took a quarter of an hour."""
    file = tmp_path / "a.csv"
    file.write_text(TABLE + (line.replace("{}", separators * 230) + "\n") * 4_000)
    with processor_time_below(5):
        assert "\n" not in sentence_of(file)


@pytest.mark.parametrize("text", ["1" * 300_000, "1." + "1" * 300_000, "1" + " " * 300_000, "1e" + "1" * 300_000])
def test_a_long_number_with_or_without_a_unit_takes_no_time(text: str) -> None:
    with processor_time_below(1):
        assert parse_quantity_in_unit(text, "mm") is None


GSI_SETUP = "*110001+{:>016} 84..10+0000000000000000 85..10+0000000000000000 88..10+0000000000000000\n"
GSI_POINTING = "*110001+00000000000000T{} 21.323+0000000001234567 22.323+0000000009012345 31..08+0000000001234567\n"
LGC_HEAD = "*TITR\nx\n*INSTR\n*POLAR T5 R 0.0\nR 3 3 0.02 0.1 0 0 0 0\n*CALA\nA 0 0 0\nB 5 0 0\n"
PLR3D = "*PLR3D\nB 1.5 100.1 5.0\n"
MANY_SETUPS = {
    "names.gsi": "".join(GSI_SETUP.format(f"S{i}") for i in range(N_SETUPS)) + GSI_POINTING.format(1),
    "one.gsi": GSI_SETUP.format("S") * N_SETUPS + GSI_POINTING.format(1),
    "stations.lgc": LGC_HEAD + "*TSTN A T5\n*V0\n" * N_SETUPS + PLR3D + "*END\n",
    "directions.lgc": LGC_HEAD + "*TSTN A T5\n" + f"*V0\n{PLR3D}" * N_SETUPS + "*END\n",
}


@pytest.mark.parametrize("name", MANY_SETUPS)
def test_set_ups_of_a_file_are_not_compared_in_pairs(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(MANY_SETUPS[name])
    with processor_time_below(15):
        assert len(read(tmp_path / name)) > 0


def test_names_that_differ_in_their_slashes_are_separated_quickly(tmp_path: Path) -> None:
    """Each of n names was compared with n names up to n times."""
    names = ["a" + "".join("/" if i >> k & 1 else "_" for k in range(13)) for i in range(2**13)]
    points = "".join(f'<point id="{name}" x="{i}" y="0" z="0" fix="xyz"/>' for i, name in enumerate(names))
    obs = f'<obs from="{names[1]}"><s-distance to="{names[2]}" val="1" stdev="1"/></obs>'
    content = f"<points-observations>{points}{obs}</points-observations>"
    (tmp_path / "a.gkf").write_text(f"<gama-local><network>{content}</network></gama-local>")
    with processor_time_below(15):
        assert "\n" not in sentence_of(tmp_path / "a.gkf")


REPORT_HEADING = "Collection;Group;Target;Azimuth (gon);Elevation (gon);Distance (mm)\n"


def test_the_name_of_an_instrument_in_a_report_is_divided_once(tmp_path: Path) -> None:
    """Every division of the name was tried: 6 s for 6 kB, and eight times as long for twice as much."""
    (tmp_path / "a.csv").write_text(
        '"CompositeReport\n"\n"Transform\n' + " - A::\u00a0" * 2_000 + f'\nx"\n{REPORT_HEADING}'
    )
    with processor_time_below(3):
        assert "no name of its set-up" in sentence_of(tmp_path / "a.csv")


def test_points_of_equal_name_in_many_groups_are_not_compared_in_pairs(tmp_path: Path) -> None:
    """Each group was compared with all earlier places: 8,000 rows took a minute."""
    head = '"CompositeReport\n"\n"Observations\nA::0 - L"\n'
    rows = "".join(f"A;G{i};T;{i % 400},5;{100 + i % 7},25;{1000 + 11 * i},5\n" for i in range(10_000))
    (tmp_path / "a.csv").write_text(head + REPORT_HEADING + rows)
    with processor_time_below(15):
        assert len(read(tmp_path / "a.csv", hints=Hints(azimuth="clockwise")).targets) == 10_000


def test_pointings_of_a_field_book_hold_equal_columns_once(tmp_path: Path) -> None:
    """A pointing with the height of its target took 300 bytes more; half a million of them 600 MB."""
    book = FieldBook(tmp_path / "a.sdr")
    book.add_setup("S", 1.5, None, SourceLocation(tmp_path / "a.sdr", 1))
    for line in range(1_000):
        where = SourceLocation(tmp_path / "a.sdr", line)
        book.add_pointing(f"T{line % 3}", where, distance=5.0, horizontal=1.0, zenith=1.5, height=1.0 + line % 2)
    assert len({id(p.covariates) for p in book.pointings}) == 2
    assert len({id(p.labels) for p in book.pointings}) == 1
    assert len({id(p.target) for p in book.pointings}) == 3


def test_lines_of_an_lgc_file_are_bounded(tmp_path: Path) -> None:
    """500,000 polar observations took 1 GB."""
    text = LGC_HEAD + "*TSTN A T5\n*V0\n*PLR3D\n" + "B 1 1 1\n" * MAX_LGC_LINES + "*END\n"
    (tmp_path / "a.lgc").write_text(text)
    assert f"has more than {MAX_LGC_LINES} lines, the limit for reading" in sentence_of(tmp_path / "a.lgc")


def test_pointings_of_a_field_book_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field_book, "MAX_FIELD_BOOK_POINTINGS", 1)
    (tmp_path / "a.gsi").write_text(GSI_SETUP.format("S") + GSI_POINTING.format(1) * 2)
    assert "row 3: more than 1 measurements, the limit for reading; divide the file" in sentence_of(tmp_path / "a.gsi")


def test_a_set_up_that_could_not_be_read_again_is_not_written() -> None:
    """The text of 100,000 set-ups took 850 MB."""
    stations = {f"S{i}": {"levelled": True, "instrument_height_mm": 1.0} for i in range(MAX_TOML_KEYS // 3)}
    setup = validate_setup({"format": "ltsim-recording/1", "stations": stations}, "setup.toml")
    with pytest.raises(RecordError, match=f"more than {MAX_TOML_KEYS} keys and tables.*divide the recording"):
        setup_to_toml(setup, "setup.toml")


def test_notes_on_a_file_are_bounded(tmp_path: Path) -> None:
    frames = "".join(f"*FRAME F{i}\n*OBSXYZ\nB 1 2 3 1 1 1\n*ENDFRAME\n*UNKNOWN{i}\nx\n" for i in range(1_000))
    (tmp_path / "a.lgc").write_text(LGC_HEAD + f"*TSTN A T5\n*V0\n{PLR3D}{frames}*END\n")
    notes = read(tmp_path / "a.lgc").notes
    assert len(notes) == MAX_NOTES_PER_FILE + 1
    assert max(map(len, notes)) < 500
    assert "further notes are not listed" in notes[-1]
