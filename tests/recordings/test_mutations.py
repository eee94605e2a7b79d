"""What slips and cuts make of a file: a recording or one sentence, in every reader, in bounded memory."""

from __future__ import annotations

import io
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ltsim.core.errors import LtsimError
from ltsim.core.randomness import random_stream
from ltsim.recordings import read, write
from ltsim.recordings.coordinates import read_coordinates, read_points
from ltsim.recordings.result_file import read_json
from tests.recordings import (
    test_cern_lgc as lgc,
    test_gama as gama,
    test_gsi as gsi,
    test_openindy as openindy,
    test_spatialanalyzer as report,
    test_tables as tables,
)
from tests.recordings.samples import workshop

TOKENS = (
    *(b"#REF!", b"NaN", b"1e999", b"-", b",", b";", b"\t", b'"', b"\x00", b"\xff", b"9" * 5000, b"145.94gon53", b"<"),
    *(b"\xe2\x88\x92", b"\n", b"[0]", b"a[0]", b"=", b"0", b"]]>", b"&x;", b"1,2,3", b"::", b"*", b"%", b" "),
)
PLACES = "Set-up;Name;X [mm];Y [mm];Z [mm];sX;sY;sZ\n" + "".join(
    f"S{s};P{t};{1000.5 * t + s:.3f};{2000 - 30.25 * s * t:.3f};{100 * t:.3f};0,01;0,01;0,02\n"
    for s in (1, 2)
    for t in range(1, 6)
)
LIST = "Punkt;Rechtswert;Hochwert;Höhe;sX\n" + "".join(f"P{i};{1000 * i};{7.5 * i};3,25;0,1\n" for i in range(6))
MATRIX = '{"format": "x", "targets": [{"name": "A", "x": 1.5, "n": 3}]}\n'


def texts(folder: Path) -> list[tuple[str, bytes, Callable[[Path], object]]]:
    """Name, content and reader of a small file of each format."""
    made = [
        tables.english, tables.german, tables.blanks, tables.sexagesimal, tables.two_faces_a_row, tables.blocks,
        tables.unnamed, report.report,
    ]  # fmt: skip
    samples = [(f"{i}.csv", make(folder / f"{i}.csv").read_bytes(), read) for i, make in enumerate(made)]
    write(workshop(), folder / "native")
    write(workshop(), folder / "p.txt", "polar-text")
    return [
        *samples,
        ("utf16.txt", tables.utf16(folder / "utf16.txt").read_bytes(), read),
        ("polar.txt", (folder / "p.txt").read_bytes(), read),
        ("observations.csv", (folder / "native" / "observations.csv").read_bytes(), read),
        ("setup.toml", (folder / "native" / "setup.toml").read_bytes(), read),
        ("net.lgc", lgc.SAMPLE.encode(), read),
        ("net.gkf", gama.SAMPLE.encode(), read),
        ("net.gsi", gsi.GSI16.encode(), read),
        ("net.xml", openindy.SAMPLE.encode(), read),
        ("places.csv", PLACES.encode("cp1252"), read),
        ("list.csv", LIST.encode("cp1252"), read_points),
        ("epoch.csv", LIST.replace("sX", "sX;sY;sZ").replace(";0,1\n", ";0,1;0,1;0,1\n").encode(), read_coordinates),
        ("result.json", MATRIX.encode(), lambda path: read_json(path, "result")),
    ]


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """One to three slips: a byte, a token, a line doubled, exchanged or gone, a cut."""
    for _ in range(int(rng.integers(1, 4))):
        at, other = sorted(rng.integers(0, len(content) + 1, 2).tolist())
        lines = content.splitlines(keepends=True)
        pick = [int(rng.integers(len(lines))) for _ in range(2)] if lines else [0, 0]
        match int(rng.integers(7)):
            case 0:
                content = content[:at] + bytes([int(rng.integers(256))]) + content[at + 1 :]
            case 1 | 2:
                content = content[:at] + TOKENS[int(rng.integers(len(TOKENS)))] + content[at + int(rng.integers(4)) :]
            case 3:
                content = content[:at] + content[min(other, at + 40) :]
            case 4:
                content = content[:at]
            case 5 if lines:
                lines[pick[0]], lines[pick[1]] = lines[pick[1]], lines[pick[0]]
                content = b"".join(lines)
            case 6 if lines:
                content = b"".join([*lines[: pick[0]], lines[pick[1]], *lines[pick[0] :]])
        content = content or b" "
    return content


def mutated_workbook(content: bytes, rng: np.random.Generator) -> bytes:
    """A workbook with slips inside one of its parts, or in the packed file itself."""
    if rng.integers(3) == 0:
        return mutated(content, rng)
    stream_ = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(stream_, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        likely = [name for name in names if "sheet" in name or "Strings" in name] * 4 + names
        chosen = likely[int(rng.integers(len(likely)))]
        for name in names:
            part = old.read(name)
            new.writestr(name, mutated(part, rng) if name == chosen else part)
    return stream_.getvalue()


def check(read_: Callable[[Path], object], path: Path) -> None:
    """It is read, or refused in one line."""
    outcome = "read"
    try:
        read_(path)
    except LtsimError as problem:
        outcome = str(problem)
    assert outcome.strip() and "\n" not in outcome, path


def survive(count: int, tmp_path: Path, seed: int) -> None:
    """`count` slips in turn over all formats, each read, in less than 500 MB more than before."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    samples = texts(tmp_path)
    book = tmp_path / "book.xlsx"
    if pytest.importorskip("openpyxl"):
        samples.append(("book.xlsx", tables.workbook(book).read_bytes(), read))
    for i in range(count):
        rng = random_stream(seed, "slips", i)
        name, content, reader = samples[i % len(samples)]
        folder = tmp_path / "native" if name in ("observations.csv", "setup.toml") else tmp_path / "slips"
        folder.mkdir(exist_ok=True)
        change = mutated_workbook if name.endswith("xlsx") else mutated
        (folder / name).write_bytes(change(content, rng))
        try:
            check(reader, folder if folder.name == "native" else folder / name)
        except Exception as problem:
            raise AssertionError(f"slip {i} of {name} ends in {problem!r}") from problem
        (folder / name).write_bytes(content)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500 * 1024


def test_500_slips_end_in_a_recording_or_a_sentence(tmp_path: Path) -> None:
    survive(500, tmp_path, 1)


@pytest.mark.long
def test_5000_slips_end_in_a_recording_or_a_sentence(tmp_path: Path) -> None:
    survive(5000, tmp_path, 2)
