"""Verbs on files with slips of a hand or a disk: a sample of every file that a verb reads, and the verb that reads it.

Slip number i of a seed is the same in every process, whichever slips were tried before it. As a program,
`python -m tests.cli.slips SEED FIRST COUNT [STRIDE]` prints the faults of a block as a line of JSON, or with a stride
of every such block from the first on.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import trimesh

import ltsim as lt
from ltsim.cli.main import run
from ltsim.core.errors import LtsimError
from ltsim.core.randomness import random_stream
from ltsim.recordings import write
from ltsim.simulation.scenario import load_scenario
from ltsim.simulation.simulator import simulate
from tests.recordings import test_sdr as sdr, test_tables as tables
from tests.recordings.test_mutations import mutated, mutated_workbook, texts
from tests.scene.test_cad import step_of

SECONDS = 30.0
"""[s] Processor time of one verb; what asks for longer work is interrupted and has to say so."""
GROWTH_KIB = 350 * 1024
"""[KiB] Memory that one verb takes beyond the libraries, which take 130 MiB."""
PLAN = """format = "ltsim-plan/1"
title = "A cell"

[workshop]
size_mm = [6000, 4000, 3000]

[[workshop.obstacles]]
name = "column"
box_mm = [300, 300, 3000]
position_mm = [2500, 1800, 0]

[[points]]
name = "P1"
x_mm = 1000
y_mm = 1000
z_mm = 800

[[points]]
name = "P2"
x_mm = 4000
y_mm = 1200
z_mm = 1500
group = "gap"

[[points]]
name = "P3"
x_mm = 2200
y_mm = 3300
z_mm = 600
weight = 2.0

[[points]]
name = "P4"
x_mm = 5200
y_mm = 3000
z_mm = 2100

[floor]
margin_mm = 500

[[floor.keep_outs]]
name = "bench"
corners_mm = [[4500, 3000], [5500, 3000], [5500, 3800], [4500, 3800]]
clear_mm = 200

[stations]
count = 2
spacing_mm = 800
min_stations_per_target = 1

[reflectors]
candidate_bodies = ["walls"]
place_spacing_mm = 4000

[budget]
max_hours = 2
faces = [1]
repeats = [1]

[goal]
targets_weight = 1.0
instrument_weight = 0.5

[search]
starts = 1
grid_step_mm = 2500
yaw_count = 1
height_count = 1
"""
POINTS_PLAN = """format = "ltsim-plan/1"
title = "A press"
points = "points.csv"

[workshop]
size_mm = [9000, 7000, 4000]
temperature_c = 21.5

[stations]
count = 2
min_stations_per_target = 1

[goal]
tolerances = [{ group = "gap", tolerance_mm = 0.5 }]

[search]
starts = 1
grid_step_mm = 3000
yaw_count = 1
height_count = 1
"""
POINTS = "name,x_mm,y_mm,z_mm,group,weight,tolerance_mm\n" + "".join(
    f"P{i},{1000 + 900 * i},{1500 + 700 * (i % 3)},{600 + 400 * (i % 2)},gap,1,0.2\n" for i in range(6)
)
CAMPAIGN = """format = "ltsim-campaign/1"
title = "few"
trials = 2
trials_per_shard = 2
verified_trials_per_shard = 0
seed = 3
statistics = ["errors"]

[grid]
"instrument.noise_factor" = [1.0, 2.0]

[[methods]]
method = "network"
"""
TASKS = """format = "ltsim-tasks/1"
title = "The flange"
source = "rec"

[[task]]
name = "length"
kind = "distance"
targets = ["T01", "T24"]
tolerances = { distance = { lower = 7934.0, upper = 7934.5 } }

[[task]]
name = "floor"
kind = "plane"
targets = ["T01", "T02", "T03", "T04", "T05"]

[monte_carlo]
max_trials = 10000
"""
ACCEPTANCE = 'format = "ltsim-acceptance/1"\nstandard = "asme-b89.4.19-2006"\ninstrument = "leica-at500"\n'
SCENARIO = """format = "ltsim-scenario/1"
title = "smaller"
base = "paper-workshop"

[work]
faces = 2

[instrument]
noise_factor = 1.5

[instrument.noise]
azimuth_arcsec = 0.4

[[effects]]
name = "station-weather"
stations = ["S4"]
values = { station-weather = 2.0 }
"""
BENCH = "angle_deg,length_um,probe_um\n" + "".join(
    f"{a},{0.02 * a * a:.3f},{0.1 * a:.3f}\n" for a in range(-40, 50, 10)
)
VALUES = (
    *(b"1e308", b"-1e308", b"nan", b"inf", b"-1", b"0", b"0.0", b"1e-320", b"9" * 400, b"0x7fffffffffffffff"),
    *(b"true", b'""', b"[]", b"{}", b"'x'", b"[[1, 2], [3]]", b"1979-05-27T07:32:00"),
    *(b'"\\u0000"', b'"../../etc/passwd"', b'"/dev/zero"'),
)
"""Values of a wrong kind or size, put in place of one that is there."""
FRAME = 'origin = "T01"\nx_axis = "T02"\nxy_plane = "T03"\n'
FOREIGN = {
    **dict.fromkeys((*(f"{i}.csv" for i in (0, 1, 2, 3, 4, 5, 7)), "utf16.txt"), ("--hint", "azimuth=clockwise")),
    "6.csv": ("--columns", "station=A,target=B,face=C,azimuth=D[deg],elevation=E[deg],distance=F[mm]"),
    **dict.fromkeys(("polar.txt", "net.lgc", "net.gkf", "net.gsi", "net.xml", "places.csv", "book.sdr"), ()),
}
"""Recordings in the formats of others, with the hints that they need."""
CAD = ("stl", "obj", "ply", "glb", "step")
"""Formats of bodies, each with a plan of its name."""
RESULTS = ("uncertainty", "comparison", "history", "next", "diagnosis")
"""Results of which a page has a section, each in a folder of its name."""
IN_PYTHON = "read"
"""Mark of a file that is read by `lt.read`."""
TO_CONVERT, TO_CORRECT = ("convert", "{}", "converted", "--force"), ("correct", "rec", "--calibration", "cal")
CASES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("plan.toml", ("plan", "{}", "--json", "--jobs", "1")),
    ("points-plan.toml", ("plan", "{}", "--json", "--jobs", "1")),
    ("points.csv", ("plan", "points-plan.toml", "--json", "--jobs", "1")),
    ("layout/plan.json", ("plan", "layout", "--without", "S1", "--json")),
    ("layout/plan.json", ("plan", "layout", "--move", "S1=1500,1200", "--json")),
    ("layout/plan.json", ("report", "layout", "--quiet")),
    *((f"body.{kind}", ("plan", f"{kind}-plan.toml", "--json", "--jobs", "1")) for kind in CAD),
    ("campaign.toml", ("campaign", "{}", "--out", "rows", "--force")),
    ("few/manifest.json", ("report", "few", "--quiet")),
    *(
        (f"few/{name}", ("campaign", "campaign.toml", "--out", "few", "--resume"))
        for name in ("manifest.json", "rows.sha256")
    ),
    ("few/rows/cell-0000/shard-000000.parquet", ("campaign", "campaign.toml", "--out", "few", "--resume")),
    ("few/rows/cell-0001/shard-000000.parquet", ("report", "few", "--quiet")),
    ("tasks.toml", ("uncertainty", "{}")),
    ("acceptance.toml", ("accept", "{}")),
    ("scenario.toml", ("simulate", "{}", "--out", "made", "--force")),
    ("scenario.toml", ("recover", "{}", "--trials", "2", "--json")),
    ("book.xlsx", (*TO_CONVERT, "--hint", "azimuth=clockwise")),
    ("book.xlsx", ("check", "{}", "--hint", "azimuth=clockwise")),
    ("table.csv", ("adjust", "{}", "--hint", "azimuth=clockwise")),
    ("table.csv", ("diagnose", "{}", "--hint", "azimuth=clockwise", "--no-held-out")),
    ("bench.csv", ("bench", "{}")),
    *(("rec/observations.csv", (verb, "rec")) for verb in ("check", "calibrate", "evaluate")),
    *(
        ("rec/observations.csv", (*words, "--force"))
        for words in (
            ("convert", "rec", "converted.txt", "--to", "polar-text"),
            ("inject", "rec", "beam-tilt", "--out", "injected"),
            (*TO_CORRECT, "--out", "corrected"),
            ("report", "rec", "--quiet"),
        )
    ),
    ("rec/observations.csv", ("adjust", "rec", "--robust", "--noise-from-data")),
    ("rec/observations.csv", ("verify", "rec", "--nominal", "control.csv", "--calibration", "cal")),
    ("rec/observations.csv", ("compare", "rec", "rec")),
    ("rec/observations.csv", ("uncertainty", "tasks.toml")),
    *((f"small/{name}", ("diagnose", "small", "--no-held-out")) for name in ("observations.csv", "setup.toml")),
    *(
        (f"small/{name}", ("convert", "small", "converted.txt", "--to", "polar-text", "--force"))
        for name in ("observations.csv", "setup.toml")
    ),
    *(("rec/setup.toml", (verb, "rec")) for verb in ("adjust", "calibrate", "check")),
    ("rec/setup.toml", ("plan", "--after", "rec", "--json")),
    *(("control.csv", (verb, "rec", "--control", "{}")) for verb in ("adjust", "check")),
    ("control.csv", ("verify", "rec", "--nominal", "{}", "--calibration", "cal")),
    ("frame.toml", ("adjust", "rec", "--frame", "{}")),
    ("cal/calibration.json", (*TO_CORRECT, "--out", "corrected", "--force")),
    ("cal/calibration.json", ("verify", "rec", "--nominal", "control.csv", "--calibration", "cal")),
    ("cal/calibration.json", ("evaluate", "rec", "--calibration", "cal")),
    ("cal/calibration.json", ("calibrate", "rec", "--prior", "{}")),
    ("cal/calibration.json", ("history", "cal", "earlier")),
    *((f"cal/{name}", ("report", "cal", "--quiet")) for name in ("calibration.json", "residuals.csv")),
    *(
        (f"cal/{name}", ("compare", "cal/targets.csv", "later.csv"))
        for name in ("targets.csv", "targets.covariance.csv")
    ),
    ("cal/targets.csv", ("adjust", "rec", "--frame", "{}")),
    ("known/truth.json", ("report", "known", "--quiet")),
    ("check/check.json", ("report", "check", "--quiet")),
    ("accept/accept.json", ("report", "accept", "--quiet")),
    *((f"{name}/{name}.json", ("report", name, "--quiet")) for name in RESULTS),
    *((f"{name}/{name}.json", (IN_PYTHON, "{}")) for name in (*RESULTS, "bench", "criteria", "recovery")),
    ("epoch.csv", ("compare", "{}", "epoch-2.csv")),
    *((name, (*TO_CONVERT, *hints)) for name, hints in FOREIGN.items()),
    *((name, ("check", "{}", *hints)) for name, hints in FOREIGN.items()),
)
"""A file and the verb that reads it: `{}` is the file itself."""
LONG = ("plan", "campaign", "recover")
"""Verbs whose file says how much work to do: an interruption is an answer."""

TEXTS = {
    "plan.toml": PLAN,
    "points-plan.toml": POINTS_PLAN,
    "points.csv": POINTS,
    "campaign.toml": CAMPAIGN,
    "tasks.toml": TASKS,
    "acceptance.toml": ACCEPTANCE,
    "scenario.toml": SCENARIO,
    "bench.csv": BENCH,
    "frame.toml": FRAME,
}
MADE = (
    "simulate paper-workshop --out rec --truth truth.json",
    "calibrate rec --out cal",
    "check rec --out check",
    "accept acceptance.toml --out accept",
    "campaign campaign.toml --out few",
    "plan plan.toml --jobs 1 --out layout",
    "diagnose small --no-held-out --out diagnosis",
    "uncertainty tasks.toml --out uncertainty",
    "compare rec rec --out comparison",
    "calibrate rec --without beam-tilt --out earlier",
    "history earlier cal --out history",
    "bench bench.csv --out bench",
    "evaluate rec --out criteria",
    "recover scenario.toml --trials 2 --out recovery",
    "plan --after rec --out next",
)


def slip(content: bytes, name: str, rng: np.random.Generator) -> bytes:
    """Content with slips of a hand or a disk, or with a value of a wrong kind."""
    if name.endswith("xlsx"):
        return mutated_workbook(content, rng)
    mark = {"toml": b" = ", "json": b": ", "csv": b","}.get(name.rpartition(".")[2])
    places = content.count(mark) if mark else 0
    if mark and places and rng.integers(2):
        before, after = _split(content, mark, int(rng.integers(places)))
        rest = after[min((i for e in (b"\n", b",") if (i := after.find(e)) >= 0), default=len(after)) :]
        return before + VALUES[int(rng.integers(len(VALUES)))] + rest
    return mutated(content, rng)


def column_twice(content: bytes, name: str) -> bytes:
    """Content with the second column of a table twice, or the first key of settings twice."""
    lines = content.splitlines(keepends=True)
    if name.endswith("toml"):
        return b"".join(line * (2 if b" = " in line else 1) for line in lines)
    mark = max((b";", b",", b"\t"), key=content.count)
    cells = [line.rstrip(b"\r\n").split(mark) for line in lines]
    return b"\n".join(mark.join([*row[:2], *row[1:]]) for row in cells) + b"\n"


def column_gone(content: bytes, name: str) -> bytes:
    """Content without the last column of a table, or without the last key of settings."""
    lines = content.splitlines(keepends=True)
    if name.endswith("toml"):
        at = max(i for i, line in enumerate(lines) if b" = " in line)
        return b"".join(lines[:at] + lines[at + 1 :])
    mark = max((b";", b",", b"\t"), key=content.count)
    return b"".join(line.rstrip(b"\r\n").rpartition(mark)[0] + b"\n" for line in lines)


def old_line_ends(content: bytes, name: str) -> bytes:
    return content.replace(b"\r\n", b"\n").replace(b"\n", b"\r")


def beginning(content: bytes, name: str) -> bytes:
    return content[: content.find(b"\n") + 1] or b" "


CHANGES = (column_twice, column_gone, old_line_ends, beginning)
"""Changes of a whole file of text, which random slips hardly ever make."""


def _split(content: bytes, mark: bytes, number: int) -> tuple[bytes, bytes]:
    parts = content.split(mark)
    return mark.join(parts[: number + 1]) + mark, mark.join(parts[number + 1 :])


@cache
def workplace() -> Path:
    """A folder in which a process works, with the samples that no verb makes."""
    folder = Path(tempfile.mkdtemp(prefix="ltsim-slips-"))
    os.chdir(folder)
    for name, text in TEXTS.items():
        Path(name).write_text(text)
    for name, content, _ in texts(folder):
        if name != "setup.toml":  # which tables beside it would take for theirs
            Path(name).write_bytes(content)
    shutil.copy("epoch.csv", "epoch-2.csv")
    sdr.written(folder / "book.sdr", sdr.book("33"))
    tables.workbook(folder / "book.xlsx")
    tables.english(folder / "table.csv")
    body = trimesh.creation.box(bounds=[[0, 0, 0], [300, 300, 3000]])
    for kind in CAD:
        Path(f"body.{kind}").write_bytes(_exported(body, kind))
        Path(f"{kind}-plan.toml").write_text(PLAN.replace("box_mm = [300, 300, 3000]", f'file = "body.{kind}"'))
    whole, _ = simulate(load_scenario("paper-workshop"), 1)
    write(whole.select((whole.station < 3) & (whole.target < 10)), folder / "small")
    return folder


@cache
def results() -> None:
    """Recordings and results in the workplace, each as its verb makes it."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as messages:
        for words in MADE:
            assert run([*words.split(), "--quiet"]) in (0, 1), f"{words}: {messages.getvalue()}"
    Path("known").mkdir()  # without coordinates, whose picture takes seconds
    Path("truth.json").rename("known/truth.json")
    shutil.copy("cal/calibration.json", "known")
    for name in ("targets.csv", "targets.covariance.csv"):
        shutil.copy(f"cal/{name}", name.replace("targets", "later"))
    rows = [",".join(row.split(",")[:4]) for row in Path("cal/targets.csv").read_text().splitlines()[1:11]]
    Path("control.csv").write_text("target,x_mm,y_mm,z_mm,sigma_mm\n" + "".join(f"{row},0.05\n" for row in rows))


def needs_results(number: int) -> bool:
    """True if a slip is one in a file that a verb makes, or that is read together with such a file."""
    name, words = CASES[number % len(CASES)]
    made = ("rec", "cal", "few", "control.csv", "later.csv", "tasks.toml")
    return ("/" in name and not name.startswith("small/")) or not {*words, name}.isdisjoint(made)


def _exported(body: trimesh.Trimesh, kind: str) -> bytes:
    """A body in [mm], in the format of its kind: glTF has metres, and y upwards."""
    upright = trimesh.creation.box(bounds=[[0, 0, -0.3], [0.3, 3, 0]]) if kind == "glb" else body
    content = step_of(body, ".MILLI.") if kind == "step" else upright.export(file_type=kind)
    return content.encode() if isinstance(content, str) else bytes(content)


def faults(seed: int, first: int, count: int) -> list[str]:
    """Faults among some slips: another end than an answer, a sentence or an interruption of long work, or much memory.

    The first of each case has no slip, and has to be answered. A failure of the test itself is a fault of its slip.
    """
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGVTALRM, interrupt)
    return [fault for i in range(first, first + count) if (fault := _reported(seed, i))]


def _reported(seed: int, number: int) -> str:
    """Fault of one slip, with the traceback where the slip could not be tried; empty for none."""
    try:
        return _fault(seed, number)
    except Exception:
        name, words = CASES[number % len(CASES)]
        return f"slip {number} of seed {seed} in {name}, {' '.join(words)}, was not tried: {traceback.format_exc()}"


def change_faults(numbers: list[int]) -> list[str]:
    """Faults after each of `CHANGES` in the files of text among the cases of these numbers."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGVTALRM, interrupt)
    texts_only = [i for i in numbers if CASES[i][0].endswith((".csv", ".toml", ".txt"))]
    return [fault for i in texts_only for change in CHANGES if (fault := _fault(0, i, change))]


def _fault(seed: int, number: int, change: Callable[[bytes, str], bytes] | None = None) -> str:
    """Fault of one slip, or of a change of the whole file; empty for none."""
    rng, whole = random_stream(seed, "verbs", number), number < len(CASES) and change is None
    name, verb = CASES[number % len(CASES)]
    words = [name if word == "{}" else word for word in verb]
    file = workplace() / name
    if needs_results(number):
        results()
    before = _contents(file)
    changed = before[file] if whole else change(before[file], name) if change else slip(before[file], name, rng)
    file.write_bytes(changed)
    held = _restarted_peak()
    error_stream, output = io.StringIO(), io.StringIO()
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    try:
        with contextlib.redirect_stdout(error_stream), contextlib.redirect_stderr(output):
            status = _status(words)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        _restore(file, before)
    errors = [line for line in output.getvalue().splitlines() if line.startswith("error: ")]
    refused = (status == 2 and len(errors) == 1) or (status == 130 and words[0] in LONG)
    right = status in (0, 1) or (refused and not whole)  # a sample that is refused would test nothing
    growth = _memory("VmHWM") - held
    if right and "Traceback" not in output.getvalue() and growth < GROWTH_KIB:
        return ""
    copy = Path(tempfile.gettempdir(), f"slip-{seed}-{number}-{file.name}")
    copy.write_bytes(changed)
    end = f"{status}, {growth >> 10} MiB, {output.getvalue()[-1500:]}"
    return f"slip {number} of seed {seed} ({copy}), {' '.join(words)}: {end}"


def _status(words: list[str]) -> int:
    """Exit status of a verb, or what `lt.read` would be as one."""
    if words[0] != IN_PYTHON:
        return run(words)
    try:
        lt.read(words[1])
    except LtsimError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 2
    return 0


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def _contents(file: Path) -> dict[Path, bytes]:
    """The file, and the others of its folder of results."""
    folder = workplace() / file.relative_to(workplace()).parts[0]
    return {path: path.read_bytes() for path in ([file] if folder == file else folder.rglob("*")) if path.is_file()}


def _restore(file: Path, before: dict[Path, bytes]) -> None:
    """Put every file back, and take away what the verb wrote among them."""
    for path in {*_contents(file)} - {*before}:
        path.unlink()
    for path, content in before.items():
        path.write_bytes(content)


STATUS, PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def _memory(name: str) -> int:
    """[KiB] Memory of this process; 0 where the system does not say it."""
    if not STATUS.exists():
        return 0
    return next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if line.startswith(f"{name}:"))


def _restarted_peak() -> int:
    """[KiB] Memory of this process, from which on its highest is counted anew."""
    with contextlib.suppress(OSError):
        PEAK.write_text("5")
    return _memory("VmHWM")


def main(seed: int, first: int, count: int, stride: int = 0, end: int = 20_000) -> None:
    """Print the faults of a block of slips, or of every block `stride` slips further up to `end`, as lines of JSON."""
    for block in range(first, end, stride) if stride else (first,):
        start, begun = time.monotonic(), time.process_time()
        problems = faults(seed, block, count)
        seconds = {"seconds": round(time.monotonic() - start, 1), "processor": round(time.process_time() - begun, 1)}
        line = {"seed": seed, "first": block, "count": count, **seconds, "faults": problems}
        print(json.dumps(line), file=sys.__stdout__, flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
