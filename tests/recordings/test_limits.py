"""Small files that stand for much are refused before anything is built; files at the limits take bounded means."""

from __future__ import annotations

import itertools
import json
import os
import resource
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest

import ltsim as lt
from ltsim.adjustment.fieldcheck import check
from ltsim.core.errors import LtsimError, ModelError, NetworkError, RecordError
from ltsim.core.limits import (
    MAX_ADJUSTED_POINTINGS,
    MAX_CALIBRATED_POINTINGS,
    MAX_JSON_VALUES,
    MAX_RESULT_TEXTS,
    MAX_TOML_KEYS,
    MAX_XML_TAGS,
    POINTINGS_LIMIT_VARIABLE,
)
from ltsim.recordings import read
from ltsim.recordings.coordinates import read_coordinates, read_points
from ltsim.recordings.files import read_lines, with_unix_line_ends
from ltsim.recordings.result_file import read_json
from ltsim.recordings.settings import _TOML_TOKEN_PATTERN, check_toml_limits, read_setup, read_toml
from ltsim.recordings.spreadsheets.sheets import read_small_table
from ltsim.recordings.xml import parse_xml
from tests.cli.slips import PLAN
from tests.recordings.samples import workshop


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 200_000 + " = 1\n",
        "a = " + "[" * 1000 + "]" * 1000 + "\n",
        "a = " + "{a = " * 1000 + "1" + "}" * 1000 + "\n",
        "[" + ".".join("a" * 40) + "]\n",
        'a = ["""x"""", ' + "[" * 40 + ', ""]\n',
        "a = ['''x'''', " + "[" * 40 + ", '']\n",
        'a = "\\"" # "\nb = ' + "[" * 40 + "\n",
    ],
)
def test_toml_that_is_nested_too_deeply_is_refused_before_it_is_parsed(text: str) -> None:
    with pytest.raises(RecordError, match="nested deeper than 32"):
        check_toml_limits(text, "a.toml")


@pytest.mark.parametrize("quotes", ['"', "'", '"""', "'''"])
def test_a_string_of_toml_that_is_not_closed_is_looked_at_once(quotes: str) -> None:
    """Each of its quotes was tried as the beginning of a string: 60 s for 6 MB, and a sixteenth of that for these."""
    before = os.times().user
    for mark in ('\\"', "\\'"):
        with suppress(RecordError):  # longer than permitted
            check_toml_limits(f"a = {quotes}" + mark * 250_000, "a.toml")
    assert os.times().user - before < 2


@pytest.mark.parametrize(
    ("quotes", "content"), [('"""', '\\"""x'), ("'''", "''x"), ('"', '\\"x'), ("'", '"x'), ('"""', '"x'), ('"""', "\\")]
)
def test_an_unclosed_toml_string_is_a_single_token_without_memory_of_its_parts(quotes: str, content: str) -> None:
    """Without its optional end it was 10,000 tokens, each looked at to the end; with backtracking it took 5 MB."""
    text = f"a = {quotes}" + content * 10_000
    tracemalloc.start()
    try:
        spans = [token.span() for token in _TOML_TOKEN_PATTERN.finditer(text)]
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert spans == [(2, 3), (4, len(text))]
    assert peak < 100_000


def test_strings_and_comments_of_toml_are_no_structure() -> None:
    quiet = '"' + "." * 100 + '"', "'" + "[" * 100 + "'", '"""\n' + "{\n" * 100 + '"""', "'''" + "[" * 100 + "'''"
    check_toml_limits("".join(f"k{i} = {text} # {'[' * 100}\n" for i, text in enumerate(quiet)), "a.toml")


def test_toml_of_too_many_keys_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("".join(f"k{i} = 1\n" for i in range(MAX_TOML_KEYS + 1)))
    with pytest.raises(RecordError, match=f"more than {MAX_TOML_KEYS} keys"):
        read_toml(file, "set-up")


@pytest.mark.parametrize("line", ["k{}.b.c = 1\n", "[k{}.b.c]\n", "[[k{}.b.c]]\n", "k{} = {{ b.c = 1 }}\n"])
def test_each_part_of_a_dotted_key_is_counted(line: str) -> None:
    """90,000 keys of 30 parts each took 3.4 GB."""
    text = "".join(line.format(i) for i in range(MAX_TOML_KEYS // 3 + 1))
    with pytest.raises(RecordError, match=f"more than {MAX_TOML_KEYS} keys"):
        check_toml_limits(text, "a.toml")
    check_toml_limits("a = [\n" + "[1.5, 2.5],\n" * 60_000 + "]\n", "a.toml")  # a point in a number is none in a key


@pytest.mark.parametrize(
    "text", ["a = {}\n", "a = 1.{}\n", "a = [1,\n{}]\n", "{} = 1\n", "a = 1979-05-27T07:32:00.{}Z\n", "a = 0x{}\n"]
)
def test_a_long_word_of_toml_is_refused_before_it_is_parsed(text: str) -> None:
    """A number of 7,000,000 digits took 0.9 GB."""
    check_toml_limits(text.format("9" * 900), "a.toml")
    for text_of_digits in ("9" * 2000, "9_" * 2000):
        with pytest.raises(RecordError, match="a key or number is longer than 1000 characters"):
            check_toml_limits("b = 1\n" + text.format(text_of_digits), "a.toml")
    check_toml_limits(f'a = "{"9" * 2000}" # {"9" * 2000}\n', "a.toml")


@pytest.mark.parametrize("quotes", ['"', "'", '"""', "'''"])
def test_a_long_text_of_toml_is_refused_before_it_is_parsed(quotes: str) -> None:
    """A title of 8 MB was copied into the results of a plan, whose report took 550 MB."""
    for n_characters, wrong in ((9_900, False), (10_001, True)):
        text = f"b = 1\na = {quotes}{'x' * n_characters}{quotes}\n"
        with pytest.raises(RecordError, match="row 2: a text is longer than 10000") if wrong else nullcontext():
            check_toml_limits(text, "a.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("<a>" * (MAX_XML_TAGS + 1), "more than 600000 tags"),
        ("<a " + " ".join(f'a{i}=""' for i in range(1001)) + "/>", "more than 1000 attributes"),
        ("<a>" * 65 + "</a>" * 65, "deeper than 64"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "declares entities"),
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>', "declares entities"),
    ],
)
def test_xml_is_bounded(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.xml").write_text(text)
    with pytest.raises(RecordError, match=says):
        parse_xml(tmp_path / "a.xml")


GAMA = "<gama-local><network><points-observations>{}</points-observations></network></gama-local>"


@pytest.mark.parametrize("tag", ["coordinates", "obs", "height-differences"])
def test_a_covariance_matrix_of_xml_is_bounded_before_it_is_split(tag: str, tmp_path: Path) -> None:
    """10,000,000 values of a matrix whose size they did not match took 800 MB."""
    file = tmp_path / "a.gkf"
    matrix = '<cov-mat dim="{}" band="{}">' + "1 " * 50 + "</cov-mat>"
    for dim, band, says in ((5000, 4999, "more than 1000000 values"), (5, 4, "do not match"), (5, 5, "do not match")):
        file.write_text(GAMA.format(f'<{tag} from="A">{matrix.format(dim, band)}</{tag}>'))
        with pytest.raises(RecordError, match=says):
            read(file)


def test_many_height_differences_have_no_joint_matrix(tmp_path: Path) -> None:
    """The matrix of 100,000 took 80 GB."""
    file, count = tmp_path / "a.gkf", 6_000
    rows = '<dh from="A" to="B" val="1" stdev="1"/>' * count
    matrix = f'<cov-mat dim="{count}" band="1">' + "1 0.5 " * (count - 1) + "1</cov-mat>"
    tracemalloc.start()
    try:
        for more in ("", matrix):
            file.write_text(GAMA.format(f"<height-differences>{rows}{more}</height-differences>"))
            with pytest.raises(RecordError, match="without pointings"):
                read(file)
        assert tracemalloc.get_traced_memory()[1] < 100e6
    finally:
        tracemalloc.stop()


def test_coordinates_with_a_joint_matrix_are_bounded(tmp_path: Path) -> None:
    """The matrix of 20,000 points takes 29 GB."""
    file = tmp_path / "a.csv"
    file.write_text("name,x_mm,y_mm,z_mm,sigma_mm\n" + "".join(f"P{i},{i},1,2,0.1\n" for i in range(20_000)))
    with pytest.raises(RecordError, match="60000 coordinates with a joint covariance matrix, expected at most 1500"):
        read_coordinates(file)
    count = 5000
    points = "".join(f"<point><id>P{i}</id><x>{i}</x></point>" for i in range(count))
    matrix = f"<cov-mat><dim>{count}</dim><band>0</band>" + "<flt>1</flt>" * count + "</cov-mat>"
    file = tmp_path / "a.xml"
    file.write_text(f"<gama-local-adjustment><adjusted>{points}</adjusted>{matrix}</gama-local-adjustment>")
    with pytest.raises(RecordError, match="5000 coordinates with a joint covariance matrix, expected at most 1500"):
        read_coordinates(file)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('{"a": [' + "{}," * MAX_JSON_VALUES + "{}]}", "more than 1500000 values"),
        ("[" * 100_000, "is not JSON"),
        ('{"a": 1e308}', "at most 1e"),
        ('{"a": -Infinity}', "at most 1e"),
        ('{"a": ' + "9" * 300 + "}", "at most 1e"),
    ],
)
def test_json_is_bounded(text: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(RecordError, match=says):
        read_json(tmp_path / "a.json", "result")


def test_every_reader_takes_the_line_ends_of_the_old_macintosh(tmp_path: Path) -> None:
    for end in ("\r", "\r\n", "\r\r\n", "\n"):
        (tmp_path / "a.csv").write_bytes(f"name,x,y,z{end}P1,1,2,3{end}P2,4,5,6{end}".encode())
        assert read_points(tmp_path / "a.csv").names == ("P1", "P2")
        assert read_lines(tmp_path / "a.csv") == ["name,x,y,z", "P1,1,2,3", "P2,4,5,6", ""]


def test_columns_of_equal_title_are_distinguished_and_refused_where_a_title_is_a_key(tmp_path: Path) -> None:
    row = "T{i},{a},{z},{z},{d}\n"
    for station in ("S1", "S2"):
        rows = [row.format(i=i, a=10 * i, z=80 + i, d=5000 + i) for i in range(6)]
        head = "Name,Hz[deg],Zenith[deg],Zenith[deg],D[mm]\n" if station == "S2" else None
        text = (head or "Name,Hz[deg],Zenith[deg],Note,D[mm]\n") + "".join(rows)
        (tmp_path / f"{station}.csv").write_text(text)
    recording = read(tmp_path)
    assert np.isfinite(recording.covariates["Zenith[deg] (2)"][6:]).all()
    (tmp_path / "table").write_text("name,value,value\na,1,2\n")
    with pytest.raises(RecordError, match="column value: this column appears twice"):
        read_small_table(tmp_path / "table")


def test_times_that_are_not_finite_are_refused_where_a_recording_is_built() -> None:
    recording = workshop()
    time = recording.time.copy()
    time[3] = np.nan
    with pytest.raises(ModelError, match="time of row 4 is nan, expected seconds of at most 2e"):
        recording.replace(time=time)
    time[3] = 1e308
    with pytest.raises(ModelError, match="time of row 4 is 1e"):
        recording.replace(time=time)


@pytest.mark.parametrize(
    "table",
    ["[instrument.prior]\nangle_arcsec", '[[gauge.distance]]\nfrom = "A"\nto = "B"\nlength_mm = 1000\nsigma_mm'],
)
def test_sigmas_whose_weights_overflow_are_refused(table: str, tmp_path: Path) -> None:
    file = tmp_path / "setup.toml"
    for sigma, wrong in (("1e-320", True), ("1e-3", False)):
        file.write_text(f'format = "ltsim-recording/1"\n{table} = {sigma}\n')
        with pytest.raises(RecordError, match="greater than or equal to") if wrong else nullcontext():
            read_setup(file)


@pytest.mark.parametrize("mark", ["[", "(", " ", ";", "-", "1 ", "((", "_ "])
def test_long_cells_take_no_time(mark: str, tmp_path: Path) -> None:
    """Patterns that try every division of a cell took minutes for one of 20,000 characters."""
    cell = mark * (19_000 // len(mark)) + "x"
    (tmp_path / "a.csv").write_text(
        "station\ttarget\tHz\tV\tdistance\n" + f"S1\t{cell}\t1\t2\t3000\n{cell}\t{cell}\n" * 20
    )
    before = os.times().user
    with pytest.raises(LtsimError):
        read(tmp_path / "a.csv")
    assert os.times().user - before < 20


@pytest.mark.parametrize("end", ["", "\n", "x"])
def test_many_carriage_returns_are_looked_at_once(end: str) -> None:
    """Each was tried as the beginning of one line break: 2 s for 80,000, and minutes for a megabyte."""
    before = os.times().user
    assert with_unix_line_ends("\r" * 1_000_000 + end) == ("\n" if end == "\n" else "\n" * 1_000_000 + end)
    assert os.times().user - before < 5
    assert with_unix_line_ends("a\r\r\nb\r\nc\rd\n") == "a\nb\nc\nd\n"


AT_LIMITS = {
    "keys.toml": 'format = "ltsim-scenario/1"\n' + "".join(f"[k{i}]\n" for i in range(MAX_TOML_KEYS - 2)),
    "flat.gkf": "<gama-local>" + "<a/>" * (MAX_XML_TAGS - 2) + "</gama-local>",
    "dicts.json": '{"format": "ltsim-calibration/1", "parameters": [' + "{}," * (MAX_JSON_VALUES // 2 - 2) + "{}]}",
}
READS = "import sys, ltsim as lt; lt.scenario(sys.argv[1]) if sys.argv[1].endswith('toml') else lt.read(sys.argv[1])"


@pytest.mark.long
@pytest.mark.parametrize("name", AT_LIMITS)
def test_files_at_the_limits_take_500_mb_and_30_s(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(AT_LIMITS[name])
    used = means(READS, str(tmp_path / name))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30


@pytest.mark.long
def test_a_field_book_of_220000_pointings_takes_500_mb_and_30_s(tmp_path: Path) -> None:
    row = "*110001+{:016d} 21.323+0000000{:09d} 22.323+0000000009012345 31..08+0000000001234567\n"
    head = "*110001+0000000000000S01 84..10+0000000000000000 85..10+0000000000000000 88..10+0000000000000000\n"
    (tmp_path / "a.gsi").write_text(
        head + "".join(row.format(i % 60, 12345 + 600_000 * (i % 60)) for i in range(220_000))
    )
    used = means(READS, str(tmp_path / "a.gsi"))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30
    assert len(read(tmp_path / "a.gsi")) == 220_000


def means(code: str, *words: str) -> resource.struct_rusage:
    """Memory and processor time of a process of Python that runs `code` with `words`."""
    with subprocess.Popen([sys.executable, "-c", code, *words], stderr=subprocess.DEVNULL) as process:
        _, _, used = os.wait4(process.pid, 0)
        process.returncode = 0
    return used


def monitoring(rows: int, path: Path) -> Path:
    """A table of eight set-ups that measure 500 targets again and again, with the time and the air temperature."""
    grid = np.arange(500)
    targets = np.stack([40 * grid - 9000.0, 37 * (7 * grid % 500) - 9000.0, 3.0 * (11 * grid % 500)], axis=1)
    lines = ["station,target,face,Hz[deg],zenith[deg],distance[mm],time[s],temperature"]
    for i in range(rows // 500):
        way = targets - [800.0 * (i % 8), -600.0 * (i % 8), 1500.0]
        length = np.linalg.norm(way, axis=1)
        turn = np.degrees(np.arctan2(way[:, 0], way[:, 1])) % 360
        zenith = np.degrees(np.arccos(way[:, 2] / length))
        lines += [
            f"S{i % 8},T{t:03d},1,{h:.6f},{z:.6f},{d:.4f},{500 * i + t},{20 + i % 7 / 10}"
            for t, h, z, d in zip(grid.tolist(), turn.tolist(), zenith.tolist(), length.tolist(), strict=True)
        ]
    path.write_text("\n".join(lines) + "\n")
    return path


def calls(work: Callable[[], object]) -> int:
    """Calls of functions written in Python that a piece of work makes."""
    counted = itertools.count()

    def count(_: object, event: str, __: object) -> None:
        if event == "call":
            next(counted)

    sys.setprofile(count)
    try:
        work()
    finally:
        sys.setprofile(None)
    return next(counted)


def test_20000_rows_are_converted_by_column(tmp_path: Path) -> None:
    """Row by row they took 400 calls each."""
    few, many = monitoring(500, tmp_path / "few.csv"), monitoring(20_500, tmp_path / "many.csv")
    read(few)  # modules are loaded now
    assert (calls(lambda: read(many)) - calls(lambda: read(few))) / 20_000 < 60
    recording = read(many)
    assert len(recording) == 20_500
    assert recording.repeat.max() == 6
    assert recording.covariates["temperature"][500] == 20.1


def test_headers_of_a_table_are_bounded(tmp_path: Path) -> None:
    lines = [
        f"station,target,Hz[deg],zenith[deg],distance[mm],n{i % 2}\nS1,T{i % 9},{i % 360},80,3000,x"
        for i in range(10_001)
    ]
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(RecordError, match="row 20001: the file holds more than 10000 headers"):
        read(tmp_path / "a.csv")


def test_advice_on_many_columns_looks_at_bounded_samples(tmp_path: Path) -> None:
    """Each column was converted for each pair of angles: two minutes for eight megabytes."""
    (tmp_path / "a.csv").write_text((",".join(["1.5"] * 300) + "\n") * 2000)

    def refused() -> None:
        with pytest.raises(RecordError, match="without a header does not say what its columns contain"):
            read(tmp_path / "a.csv")

    refused()
    assert calls(refused) < 4_000_000


@pytest.mark.long
def test_400000_rows_take_10_s_and_400_mb(tmp_path: Path) -> None:
    used = means(READS, str(monitoring(400_000, tmp_path / "a.csv")))
    assert used.ru_maxrss < 400 * 1024
    assert used.ru_utime + used.ru_stime < 10


VERB = "import sys; from ltsim.cli.main import run; sys.exit(run(sys.argv[1:]))"
WITHOUT_MYPY = "import sys; sys.modules['mypy'] = None;"
"""Beginning of code that runs as for a user: pyvista imports mypy where it is installed, which takes 15 MB."""


@pytest.mark.long
def test_400000_coordinates_are_refused_within_400_mb(tmp_path: Path) -> None:
    """They took 530 MB: each row of the list was kept with its texts."""
    file = str(tmp_path / "a.csv")
    rows = "".join(f"T{i},{i},{i * 7 % 1000},{i * 3 % 500},0.1\n" for i in range(400_000))
    Path(file).write_text("target,x_mm,y_mm,z_mm,sigma_mm\n" + rows)
    used = means(VERB, "compare", file, file)
    assert used.ru_maxrss < 400 * 1024
    assert used.ru_utime + used.ru_stime < 30


@pytest.mark.long
def test_500_points_that_all_moved_are_compared_within_500_mb_and_30_s(tmp_path: Path) -> None:
    """160 points of a file of 6 kB took minutes: each step of the search fitted all of them again for each point."""
    rng = np.random.default_rng(1)
    for name, shift in (("a", 0.0), ("b", 3.0)):
        points = [
            f"T{i},{37 * i % 9000},{7919 * i % 8000},{3 * i % 500 + shift * rng.normal()},0.1" for i in range(500)
        ]
        (tmp_path / f"{name}.csv").write_text("\n".join(("target,x_mm,y_mm,z_mm,sigma_mm", *points)) + "\n")
    used = means(VERB, "compare", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--out", str(tmp_path / "out"))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30
    assert len(lt.read(tmp_path / "out").moved_points) > 400


@pytest.mark.long
@pytest.mark.parametrize("sight", ["S1,T{}", "S{},T1"])
def test_490000_names_are_converted_within_500_mb_and_30_s(sight: str, tmp_path: Path) -> None:
    """Names of targets took 612 MB: rows and columns were both in memory. Names of set-ups took 650 MB and 38 s."""
    rows = (
        f"{sight.format(i)},1,{i * 7 % 360}.12345,{i * 3 % 40}.12345,{1000 + i % 9000}.123\n" for i in range(490_000)
    )
    (tmp_path / "a.csv").write_text("station,target,face,azimuth_deg,elevation_deg,distance_mm\n" + "".join(rows))
    used = means(VERB, "convert", str(tmp_path / "a.csv"), str(tmp_path / "out"))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30
    assert (tmp_path / "out" / "observations.csv").is_file()


LARGEST = {
    "adjust": MAX_ADJUSTED_POINTINGS,
    "check": MAX_ADJUSTED_POINTINGS,
    "calibrate": MAX_CALIBRATED_POINTINGS,
}


@pytest.mark.long
@pytest.mark.parametrize("verb", LARGEST)
def test_largest_recording_of_a_verb_takes_500_mb_and_30_s(verb: str, tmp_path: Path) -> None:
    used = means(VERB, verb, str(noisy_monitoring(LARGEST[verb], tmp_path)))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30


@pytest.mark.long
@pytest.mark.parametrize("effects", ["station-bump:S2 range-cyclic target-moved:T100", "turbulence"])
def test_diagnosis_of_1500_pointings_with_several_causes_takes_500_mb_and_30_s(effects: str, tmp_path: Path) -> None:
    recording, injected = str(noisy_monitoring(1_500, tmp_path)), str(tmp_path / "injected")
    means(VERB, "inject", recording, *effects.split(), "--noncentrality", "400", "--out", injected)
    used = means(VERB, "diagnose", injected, "--out", str(tmp_path / "out"))
    assert lt.read(tmp_path / "out").verdict == "mismatch"
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30


@pytest.mark.long
def test_report_of_a_large_recording_takes_at_most_100_mb_more_than_of_a_small_recording(tmp_path: Path) -> None:
    """The 3D view takes 480 MB whatever it shows."""
    peaks = [
        means(VERB, "report", str(noisy_monitoring(rows, tmp_path / str(rows)))).ru_maxrss
        for rows in (2_000, MAX_ADJUSTED_POINTINGS)
    ]
    assert peaks[1] - peaks[0] < 100 * 1024


@pytest.mark.long
@pytest.mark.parametrize("is_largest", [False, True])
def test_report_of_a_plan_takes_500_mb(is_largest: bool, tmp_path: Path) -> None:
    """It took 532 MB, of which 43 MB were a library for the rays, and 565 MB with three times as many texts."""
    (tmp_path / "plan.toml").write_text(PLAN)
    folder = str(tmp_path / "layout")
    means(VERB, "plan", str(tmp_path / "plan.toml"), "--jobs", "1", "--out", folder)
    file = tmp_path / "layout" / "plan.json"
    content = json.loads(file.read_text())
    entry = content["tradeoff_points"][0]
    n_stations = (MAX_RESULT_TEXTS - 2_000) // 100 // 3  # an object, a name and a position each
    stations = [entry["layout"][0] | {"name": f"S{i}"} for i in range(n_stations)]
    if is_largest:
        file.write_text(json.dumps(content | {"files": {}, "tradeoff_points": [entry | {"layout": stations}] * 100}))
    used = means(f"{WITHOUT_MYPY} {VERB}", "report", folder)
    assert (tmp_path / "layout" / "report.html").is_file()
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 30


@pytest.mark.long
@pytest.mark.parametrize("verb", ["adjust", "check", "calibrate", "diagnose", "evaluate", "report", "convert"])
def test_400000_pointings_are_used_or_refused_before_the_work(verb: str, tmp_path: Path) -> None:
    folder = noisy_monitoring(400_000, tmp_path)
    used = means(VERB, verb, str(folder), *([str(tmp_path / "out")] if verb == "convert" else []))
    assert used.ru_maxrss < 500 * 1024
    assert used.ru_utime + used.ru_stime < 20


MAKES = "import sys; from tests.recordings.test_limits import write_noisy; write_noisy(int(sys.argv[1]), sys.argv[2])"


def noisy_monitoring(rows: int, folder: Path) -> Path:
    """Folder of the recording of `monitoring`, whose readings scatter as declared.

    A process of its own makes it: the memory of this one would count for the processes that it starts.
    """
    folder.mkdir(exist_ok=True)
    means(MAKES, str(rows), str(folder))
    return folder / "recording"


def write_noisy(rows: int, folder: str) -> None:
    recording = read(monitoring(rows, Path(folder, "a.csv")))
    noise = np.random.default_rng(7).normal(size=recording.readings.shape) * recording.reading_sigmas()
    lt.write(recording.with_readings(recording.readings + noise), Path(folder, "recording"))


def test_a_recording_with_too_many_pointings_is_refused_with_the_way_to_thin_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ltsim.adjustment.estimate.MAX_ADJUSTED_POINTINGS", 100)
    monkeypatch.setattr("ltsim.adjustment.identification.selection.MAX_ADJUSTED_POINTINGS", 100)
    recording, _ = lt.simulate("paper-workshop", seed=7)
    whole = recording.select(np.repeat(np.arange(len(recording)), 3))
    with pytest.raises(
        NetworkError, match="holds 420 pointings; an adjustment takes at most 100: divide it by station"
    ):
        lt.adjust(whole)
    monkeypatch.setattr("ltsim.adjustment.estimate.MAX_ADJUSTED_POINTINGS", 200)
    monkeypatch.setattr("ltsim.adjustment.identification.selection.MAX_ADJUSTED_POINTINGS", 200)
    with pytest.raises(
        NetworkError, match=r"holds 420 pointings; an adjustment takes at most 200: convert it .*every 3"
    ):
        lt.adjust(whole)
    thinned = lt.convert(whole, tmp_path / "thinned", every=3)
    assert np.array_equal(thinned.readings, recording.readings)
    assert len(lt.adjust(thinned).target_names) == 28


def test_a_check_of_a_single_set_up_with_too_many_pointings_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys.modules["ltsim.adjustment.fieldcheck.check"], "MAX_ADJUSTED_POINTINGS", 20)
    recording, _ = lt.simulate("paper-workshop", seed=7)
    set_up = recording.select(recording.station == 0)
    with pytest.raises(NetworkError, match=rf"holds {len(set_up)} pointings; a check takes at most 20"):
        check(set_up)


def test_the_environment_raises_the_largest_number_of_pointings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ltsim.adjustment.estimate.MAX_ADJUSTED_POINTINGS", 100)
    recording, _ = lt.simulate("paper-workshop", seed=7)
    monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, str(len(recording)))
    assert len(lt.adjust(recording).target_names) == 28
    monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, str(len(recording) - 1))
    with pytest.raises(
        NetworkError,
        match=f"at most 139: .* set the environment variable {POINTINGS_LIMIT_VARIABLE} to 140",
    ):
        lt.adjust(recording)
    monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, "99")
    with pytest.raises(NetworkError, match="at most 100"):
        lt.adjust(recording)
    for wrong in ("many", "-5", "1e5", "9" * 5000):
        monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, wrong)
        with pytest.raises(ModelError, match=f"{POINTINGS_LIMIT_VARIABLE} is .*; expected a whole number of pointings"):
            lt.adjust(recording)


def test_many_effects_of_many_pointings_are_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """30 effects of 30,000 pointings took more than four minutes; 28 of 14,000 pointings took 747 MB in a campaign."""
    recording, _ = lt.simulate("paper-workshop", seed=7)
    effects = ["target-moved:T01", "target-moved:T02"]
    monkeypatch.setattr("ltsim.core.limits.MAX_EFFECTS_TIMES_POINTINGS", 2 * len(recording) - 1)
    with pytest.raises(ModelError, match="2 effects of 140 pointings are estimated together, expected at most 1"):
        lt.calibrate(recording, with_effects=effects)
    assert lt.calibrate(recording, with_effects=effects[:1]).effects
    tables = "".join(f'[[methods.effects]]\nname = "target-moved"\ntargets = ["{t[-3:]}"]\n' for t in effects)
    file = tmp_path / "a.toml"
    file.write_text(f'format = "ltsim-campaign/1"\ntrials = 2\n[[methods]]\nmethod = "network"\n{tables}')
    with pytest.raises(LtsimError, match=r"cell 1 .*: 2 effects of 140 pointings are estimated together"):
        lt.campaign(file, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv(POINTINGS_LIMIT_VARIABLE, str(2 * len(recording)))
    assert lt.calibrate(recording, with_effects=effects).effects


def test_thinning_retains_the_first_of_each_sight_and_then_regular_samples() -> None:
    recording, _ = lt.simulate("paper-workshop", seed=7)
    whole = recording.select(np.tile(np.arange(len(recording)), 5))
    thinned = whole.thin(2)
    assert len(thinned) == 3 * len(recording)
    assert len(whole.thin(9)) == len(recording)
    assert np.array_equal(thinned.readings[-len(recording) :], recording.readings)


def test_a_network_of_too_many_set_ups_is_refused_before_pairs_of_them_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flags of 25,000 set-ups and 25,000 targets would take 600 MB, misfits of 49,000 set-ups in pairs 19 GB."""
    file = tmp_path / "a.csv"
    rows = "".join(f"S{i},T1,1,{i % 360},1,3000\n" for i in range(20_000))
    file.write_text("station,target,face,azimuth_deg,elevation_deg,distance_mm\n" + rows)
    before = os.times().user
    for verb in (lt.adjust, lt.check, lt.calibrate, lt.diagnose):
        with pytest.raises(NetworkError, match=r"holds 20000 set-ups; .* takes at most 500: divide it by station"):
            verb(file)
    assert os.times().user - before < 30
    monkeypatch.setattr("ltsim.recordings.recording.MAX_NETWORK_SETUPS", 4)
    recording, _ = lt.simulate("paper-workshop", seed=7)
    with pytest.raises(NetworkError, match=rf"5 set-ups; .* set the environment variable {POINTINGS_LIMIT_VARIABLE}"):
        lt.check(recording)


def test_a_network_of_too_many_targets_is_refused(tmp_path: Path) -> None:
    """10,000 targets of two set-ups took 1 GB to adjust, and 4.2 GB to calibrate."""
    file = tmp_path / "a.csv"
    rows = "".join(f"S{s},T{i},1,{i % 360},{i % 40},{3000 + i}\n" for s in (1, 2) for i in range(6_001))
    file.write_text("station,target,face,azimuth_deg,elevation_deg,distance_mm\n" + rows)
    limit_by_verb = {lt.adjust: 6_000, lt.check: 6_000, lt.calibrate: 2_500, lt.diagnose: 1_500}
    for verb, limit in limit_by_verb.items():
        with pytest.raises(NetworkError, match=rf"holds 6001 targets; .* takes at most {limit}: leave out targets"):
            verb(file)


def test_equal_objects_of_a_file_share_a_dictionary_if_their_numbers_are_written_equally(tmp_path: Path) -> None:
    """The scenarios of 3,660 cells of a campaign took 150 MB while they were read."""
    entry, other = '{"x": [0.5, {"y": 1}]}', '{"x": [0.5, {"y": 1.0}]}'
    texts = [entry, entry, other, '{"x": [-0.0]}', '{"x": [0.0]}']
    file = tmp_path / "a.json"
    file.write_text(f'{{"entries": [{", ".join(texts)}]}}')
    shared = read_json(file, "result", shares_equal_objects=True)["entries"]
    separate = read_json(file, "result")["entries"]
    assert repr(shared) == repr(separate)
    assert shared[0] is shared[1] and separate[0] is not separate[1]
    assert len({id(entry) for entry in shared}) == 4


def test_objects_in_each_other_are_compared_in_linear_time(tmp_path: Path) -> None:
    """A comparison by their texts would take the square of their number."""
    file = tmp_path / "a.json"
    deep = '{"a": ' * 300 + "[" + ", ".join(["1"] * 3000) + "]" + "}" * 300
    file.write_text(f'{{"entries": [{", ".join([deep] * 20)}]}}')
    begun = time.process_time()
    entries = read_json(file, "result", shares_equal_objects=True)["entries"]
    assert len({id(entry) for entry in entries}) == 1
    assert time.process_time() - begun < 2.0
