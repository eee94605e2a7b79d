"""Verbs on files with slips: an answer or one sentence, in bounded memory and time, whatever the slip."""

from __future__ import annotations

import contextlib
import io
import os
import resource
import signal
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from ltsim.cli.main import run
from ltsim.core.randomness import stream
from tests.recordings import test_tables as tables
from tests.recordings.test_mutations import mutated, mutated_workbook

BATCH = 50
SECONDS = 30.0
"""[s] Processor time of one verb; what asks for longer work is interrupted and has to say so."""
GROWTH_KIB = 500 * 1024
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
on = ["walls"]
place_spacing_mm = 4000

[budget]
hours = 2
faces = [1]
repeats = [1]

[goal]
targets = 1.0
instrument = 0.5

[search]
starts = 1
grid_mm = 2500
yaws = 1
heights = 1
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
tolerances = [{ group = "gap", within_mm = 0.5 }]

[search]
starts = 1
grid_mm = 3000
yaws = 1
heights = 1
"""
POINTS = "name,x_mm,y_mm,z_mm,group,weight,tolerance_mm\n" + "".join(
    f"P{i},{1000 + 900 * i},{1500 + 700 * (i % 3)},{600 + 400 * (i % 2)},gap,1,0.2\n" for i in range(6)
)
CAMPAIGN = """format = "ltsim-campaign/1"
title = "few"
trials = 2
shard = 2
verify = 0
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
most_trials = 10000
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
VERBS: dict[str, tuple[str, ...]] = {
    "plan.toml": ("plan", "{}", "--json"),
    "points-plan.toml": ("plan", "{}", "--json"),
    "points.csv": ("plan", "points-plan.toml", "--json"),
    "campaign.toml": ("campaign", "{}", "--out", "rows", "--force"),
    "tasks.toml": ("uncertainty", "{}"),
    "acceptance.toml": ("accept", "{}"),
    "scenario.toml": ("simulate", "{}", "--out", "made", "--force"),
    "book.xlsx": ("convert", "{}", "converted", "--force", "--hint", "azimuth=clockwise"),
    "table.csv": ("adjust", "{}", "--hint", "azimuth=clockwise"),
    "bench.csv": ("bench", "{}"),
    "rec/observations.csv": ("check", "rec"),
    "rec/setup.toml": ("adjust", "rec"),
    "cal/calibration.json": ("correct", "rec", "--calibration", "cal", "--out", "corrected", "--force"),
    "cal/targets.csv": ("compare", "{}", "cal/targets.csv"),
    "check/check.json": ("report", "check", "--quiet"),
    "known/truth.json": ("report", "known", "--quiet"),
    "accept/accept.json": ("report", "accept", "--quiet"),
    "few/manifest.json": ("report", "few", "--quiet"),
}
"""The verb that reads each file: `{}` is the file itself."""
LONG = ("plan", "campaign")
"""Verbs whose file says how much work to do: an interruption is an answer."""


def slip(content: bytes, name: str, rng: np.random.Generator) -> bytes:
    """Content with slips of a hand or a disk, or with a value of a wrong kind."""
    if name.endswith("xlsx"):
        return mutated_workbook(content, rng)
    mark = {"toml": b" = ", "json": b": ", "csv": b","}[name.rpartition(".")[2]]
    places = content.count(mark)
    if places and rng.integers(2):
        before, after = _split(content, mark, int(rng.integers(places)))
        rest = after[min((i for e in (b"\n", b",") if (i := after.find(e)) >= 0), default=len(after)) :]
        return before + VALUES[int(rng.integers(len(VALUES)))] + rest
    return mutated(content, rng)


def _split(content: bytes, mark: bytes, number: int) -> tuple[bytes, bytes]:
    parts = content.split(mark)
    return mark.join(parts[: number + 1]) + mark, mark.join(parts[number + 1 :])


@cache
def workplace() -> Path:
    """A folder with every sample, in which a process works."""
    folder = Path(tempfile.mkdtemp(prefix="ltsim-slips-"))
    os.chdir(folder)
    texts = {
        "plan.toml": PLAN,
        "points-plan.toml": POINTS_PLAN,
        "points.csv": POINTS,
        "campaign.toml": CAMPAIGN,
        "tasks.toml": TASKS,
        "acceptance.toml": ACCEPTANCE,
        "scenario.toml": SCENARIO,
        "bench.csv": BENCH,
    }
    for name, text in texts.items():
        Path(name).write_text(text)
    tables.workbook(folder / "book.xlsx")
    tables.english(folder / "table.csv")
    made = [
        ("simulate", "paper-workshop", "--out", "rec", "--truth", "truth.json"),
        ("calibrate", "rec", "--out", "cal"),
        ("check", "rec", "--out", "check"),
        ("accept", "acceptance.toml", "--out", "accept"),
        ("campaign", "campaign.toml", "--out", "few"),
    ]
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        assert [run([*words, "--quiet"]) in (0, 1) for words in made] == [True] * len(made)
    Path("known").mkdir()  # without coordinates, whose picture takes seconds
    Path("truth.json").rename("known/truth.json")
    Path("known/calibration.json").write_bytes(Path("cal/calibration.json").read_bytes())
    return folder


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def faults(seed: int, first: int) -> list[str]:
    """Faults among a batch of slips: another end than an answer, one sentence or an interruption of long work.

    The first of each file has no slip, and has to be answered.
    """
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGVTALRM, interrupt)
    folder, found, names = workplace(), [], list(VERBS)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for i in range(first, first + BATCH):
        rng, name, whole = stream(seed, "verbs", i), names[i % len(names)], i < len(names)
        file = folder / name
        content = file.read_bytes()
        words = [name if word == "{}" else word for word in VERBS[name]]
        said, told = io.StringIO(), io.StringIO()
        file.write_bytes(content if whole else slip(content, name, rng))
        signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
        try:
            with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
                status = run(words)
        finally:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0)
            changed = file.read_bytes()
            file.write_bytes(content)
        errors = [line for line in told.getvalue().splitlines() if line.startswith("error: ")]
        refused = (status == 2 and len(errors) == 1) or (status == 130 and words[0] in LONG)
        right = status in (0, 1) or (refused and not whole)  # a sample that is refused would test nothing
        if not right or "Traceback" in told.getvalue():
            Path(tempfile.gettempdir(), f"slip-{seed}-{i}-{file.name}").write_bytes(changed)
            found.append(f"slip {i} of {name}, {' '.join(words)}: {status}, {told.getvalue()[-1500:]}")
    growth = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return [*found, *([f"slips {first} and on took {growth >> 10} MiB"] if growth > GROWTH_KIB else [])]


def survive(count: int, seed: int, jobs: int) -> None:
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        found = list(pool.map(faults, [seed] * -(-count // BATCH), range(0, count, BATCH)))
    assert [fault for batch in found for fault in batch] == []


def test_20_slips_end_in_an_answer_or_a_sentence() -> None:
    pytest.importorskip("numba", reason="campaigns need their extra")
    survive(20, 1, 1)


@pytest.mark.long
@pytest.mark.timeout(36_000)
def test_20000_slips_end_in_an_answer_or_a_sentence() -> None:
    survive(20_000, 2, min(os.cpu_count() or 1, 8))
