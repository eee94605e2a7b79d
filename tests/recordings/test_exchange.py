"""Every format: chosen by content, refused in one sentence when damaged, in bounded time and memory."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

from ltsim.core.errors import RecordError
from ltsim.recordings import FORMATS, Hints, read, recognise_format, write
from tests.recordings import (
    test_cern_lgc,
    test_gama,
    test_gsi,
    test_openindy,
    test_polar_text,
    test_sdr,
    test_spatialanalyzer,
    test_tables,
)
from tests.recordings.samples import outcome, workshop

HINTS = Hints(azimuth="clockwise")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """A small whole file of every format, under a name that says nothing."""
    write(workshop(), tmp_path / "native")
    points = tmp_path / "a-points"
    points.write_text("A 1 2 3\nB 2 3 4\n")
    return {
        "native": tmp_path / "native",
        "spatialanalyzer": test_spatialanalyzer.report(tmp_path / "a-report"),
        "cern-lgc": test_cern_lgc.sample(tmp_path / "a-lgc"),
        "gama-local": test_gama.sample(tmp_path / "a-gama"),
        "openindy": test_openindy.project(tmp_path / "a-project"),
        "gsi": test_gsi.gsi(tmp_path / "a-gsi"),
        "sdr": test_sdr.written(tmp_path / "a-sdr", test_sdr.book("33")),
        "polar-text": test_polar_text.printed(tmp_path / "a-text", workshop()),
        "point-list": points,
        "table": test_tables.english(tmp_path / "a-table"),
    }


def test_formats_are_recognised_by_content(files: dict[str, Path]) -> None:
    assert {f.name for f in FORMATS} == set(files)
    for name, path in files.items():
        assert recognise_format(path).name == name
        if name != "point-list":
            assert len(read(path, hints=HINTS)) > 2


@pytest.mark.parametrize(
    "name", ["spatialanalyzer", "cern-lgc", "gsi", "sdr", "polar-text", "table", "gama-local", "openindy"]
)
def test_pointings_know_their_lines(name: str, files: dict[str, Path]) -> None:
    """Lines of the file on which the target of a pointing stands; OpenIndy's observations begin on it."""
    recording = read(files[name], hints=HINTS)
    lines = files[name].read_text(encoding="latin-1").splitlines()
    for row in range(1, len(recording) + 1):
        match = re.search(r", lines? ([\d, ]+)\)$", recording.row_text(row))
        assert match is not None, recording.row_text(row)
        target = "<observation" if name == "openindy" else recording.targets[recording.target[row - 1]].split("/")[-1]
        assert all(target in lines[int(number) - 1] for number in match[1].split(",")), recording.row_text(row)


def test_unknown_things(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("nothing that anybody knows\n")
    (tmp_path / "b.txt").write_bytes(bytes(range(256)))
    for path, says in (
        (tmp_path / "a.txt", "is in none of the formats"),
        (tmp_path / "b.txt", "in none"),
        (tmp_path / "c", "no such"),
    ):
        with pytest.raises(RecordError, match=says):
            read(path)
    with pytest.raises(RecordError, match="there is no format called 'gamma'; did you mean gama-local"):
        read(tmp_path / "a.txt", format="gamma")
    with pytest.raises(RecordError, match="there is no format called 'gsi'"):
        write(workshop(), tmp_path / "out", "gsi")
    write(workshop(), tmp_path / "trial" / "recording")
    with pytest.raises(RecordError, match="trial: the folder is not a recording, but contains a recording; give "):
        read(tmp_path / "trial")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_is_refused_in_a_sentence(files: dict[str, Path], data: st.DataObject) -> None:
    name = data.draw(st.sampled_from([n for n in files if n != "native"]))
    whole = files[name].read_bytes()
    at = data.draw(st.integers(0, len(whole)))
    words = [b"", b'"', b";", b"\n", b"nan", b"1e999", b"\xff\xfe", b"\x00", b"-", b"<", b"&a;", b"*V0\n", b" " * 50]
    piece = data.draw(st.binary(max_size=6) | st.sampled_from(words))
    files[name].write_bytes(whole[:at] + piece + whole[at + data.draw(st.integers(0, 40)) :])
    try:
        outcome(lambda: read(files[name], format=name, hints=HINTS))
        outcome(lambda: read(files[name], hints=HINTS))
    finally:
        files[name].write_bytes(whole)


@pytest.mark.parametrize("name", [f.name for f in FORMATS if f.name != "native"])
@pytest.mark.parametrize("filler", [b"9", b" ", b"\n", b"a,", b"<a>", b"*V0\n", b"S1 T1 1 1 1\n"])
def test_floods_are_bounded(tmp_path: Path, name: str, filler: bytes, files: dict[str, Path]) -> None:
    """100 kilobytes of one thing after a good beginning: an answer in little memory, before the test's time is up."""
    path = files[name]
    path.write_bytes(path.read_bytes()[:300] + filler * (100_000 // len(filler)))
    tracemalloc.start()
    outcome(lambda: read(path, format=name, hints=HINTS))
    assert tracemalloc.get_traced_memory()[1] < 75_000_000
    tracemalloc.stop()
