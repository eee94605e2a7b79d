"""First reports of each command for simple causes of all sizes, compared with data snooping and GNU Gama.

    python -m experiments 29             # all halls; ten minutes of processor time
    python -m experiments 29 tables      # the tables of the committed rows, in seconds

GNU Gama takes part if `gama-local` is on the PATH.
"""

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd

import ltsim as lt
from experiments.common import Options, Row, RunRecord, print_line, show_table, write_table
from experiments.intervals import proportion
from ltsim.adjustment.identification.cause_tests import CauseTest
from ltsim.core.errors import LtsimError
from ltsim.core.parallel import run_parallel
from ltsim.diagnosis.schema import Finding
from ltsim.recordings import Recording

from . import peers
from .hall import UNITS, Cause, Hall, Observations, Place, name_of

RIGHT = "right"
MIN_PROBABILITY = 0.5
"""Probability from which a further finding at a wrong place makes the report of `diagnose` wrong."""
FACTOR, ALLOWANCE = 1.3, 2e-6
"""Factor, and additional length [m], up to which coordinate errors count as those without the cause."""
LIMIT_S = 60.0
SMALL_SIZE = 1e-6
"""Size [SI] at which the noncentrality is evaluated; it is proportional to the square of the size."""


@dataclass(frozen=True)
class Report:
    """Coordinates and reports of a program.

    `points` (T, 3) [m] is None for a program without coordinates. `names_place` is True if the first report has the
    place of the cause, `names_other` if another place is reported, `rejects` if anything is reported.
    """

    points: np.ndarray | None
    names_place: bool
    names_other: bool
    rejects: bool


Entrant = Callable[[Observations, Recording, Place, Path], Report]


def _coordinates(result: Any, count: int) -> np.ndarray:
    """Coordinates (T, 3) [m] of a result in the order of the targets; NaN for missing targets."""
    table = result.to_dataframe("targets").set_index("target")
    names = [name_of(k) for k in range(count)]
    return np.asarray(1e-3 * table.reindex(names)[["x_mm", "y_mm", "z_mm"]].to_numpy(dtype=float))


def _where(report: CauseTest | Finding) -> tuple[set[str], set[str]]:
    return set(report.where.stations), set(report.where.targets)


def _report_of_tests(result: Any, place: Place, count: int) -> Report:
    accepted = [test for test in result.tests if test.accepted]
    at = [place.includes(*_where(test)) for test in accepted]
    return Report(_coordinates(result, count), at[:1] == [True], not all(at), bool(accepted))


def adjust(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of `ltsim adjust`."""
    return _report_of_tests(lt.adjust(recording), place, len(observations.hall.points))


def calibrate(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of `ltsim calibrate`."""
    return _report_of_tests(lt.calibrate(recording, advise=False), place, len(observations.hall.points))


def diagnose(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of `ltsim diagnose`."""
    result = lt.diagnose(recording, held_out=False)
    reported = [f for f in result.findings if f.evidence.probability >= MIN_PROBABILITY or f is result.findings[0]]
    at = [place.includes(*_where(finding)) for finding in reported]
    points = _coordinates(result, len(observations.hall.points))
    return Report(points, at[:1] == [True], not all(at), bool(result.findings))


def check(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of `ltsim check`, from its first sentence."""
    result = lt.check(recording)
    return Report(None, says(result.sentence, place), False, not result.passed)


def says(text: str, place: Place) -> bool:
    """True if a text contains every station and target of a place, or the word `noise` if the place is empty."""
    names = sorted(place.stations | place.targets)
    if not names:
        return "noise" in text
    return all(re.search(rf"(?<![A-Za-z0-9]){name}(?![0-9])", text) for name in names)


def snooping(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of the plain adjustment with data snooping."""
    return _report_of_peer(peers.snooping(observations), place)


def gama(observations: Observations, recording: Recording, place: Place, folder: Path) -> Report:
    """Report of GNU Gama."""
    return _report_of_peer(peers.gama(observations, folder / "gama"), place)


def _report_of_peer(answer: peers.Answer, place: Place) -> Report:
    """Report from one rejected observation.

    If a cause acts on several observations, any of them has the right place.
    """
    stations, targets = answer.stations, answer.targets
    at_targets = bool(place.targets & targets) or not place.targets
    named = bool(place.stations | place.targets) and place.stations <= stations and at_targets
    return Report(answer.points, named, False, bool(stations | targets))


ENTRANTS: Mapping[str, Entrant] = {f.__name__: f for f in (check, adjust, calibrate, diagnose, snooping, gama)}


def error(points: np.ndarray, hall: Hall, lost: Sequence[int]) -> float:
    """Rms error [m] of coordinates in the frame of the control points, without the targets in `lost`."""
    rows = np.setdiff1d(np.arange(len(points)), lost)
    return float(np.sqrt(np.mean(np.sum((points[rows] - hall.points[rows]) ** 2, axis=1))))


def verdict(name: str, report: Report, cause: Cause | None, is_good: bool) -> str:
    """Verdict on a report: it begins with `right`, or names what is wrong.

    `check` is also right if it passes a recording whose noise is smaller than declared.
    """
    should_pass = cause is None or (cause.name == "noise of a factor" and cause.size < 1.0)
    if name == "check":
        if should_pass:
            return "stops" if report.rejects else RIGHT
        return RIGHT if report.rejects and report.names_place else "place" if report.rejects else "passes"
    if cause is None:
        return "false report" if report.rejects else RIGHT
    if name == "diagnose":
        wrong = {"place": not report.names_place, "elsewhere": report.names_other, "coordinates": not is_good}
        return ", ".join(word for word, fails in wrong.items() if fails) or RIGHT
    if report.names_place and is_good:
        return RIGHT
    return f"{RIGHT}: place" if report.names_place else f"{RIGHT}: coordinates" if is_good else "place, coordinates"


def answer(name: str, observations: Observations, cause: Cause | None, folder: Path) -> tuple[str, Report | None]:
    """Problem (empty if there is none) and report of a program on observations; None for the report after a failure."""
    hall, start = observations.hall, time.process_time()
    place = hall.place(cause) if cause else Place()
    try:
        recording = lt.read(observations.write(folder))
        report = ENTRANTS[name](observations, recording, place, folder)
    except LtsimError as problem:
        named = bool(place.stations | place.targets) and says(str(problem), place)
        report = Report(None, named, False, True) if named else None
        return "" if named else "no answer", report
    except (ArithmeticError, ValueError, RuntimeError) as problem:
        return f"broke down: {type(problem).__name__}", None
    seconds = time.process_time() - start
    return f"{seconds:.0f} s" if seconds > LIMIT_S else "", report


def rungs(hall: Hall, causes: Sequence[Cause | None], number: int, names: Sequence[str]) -> list[Row]:
    """Verdicts of all programs on recordings of a hall with the same noise, each with one cause or none."""
    rows = []
    references: dict[tuple[str, tuple[int, ...]], float] = {}
    with TemporaryDirectory() as folder:
        for cause in causes:
            lost, row = hall.lost_targets(cause) if cause else (), Row()
            for name in names:
                problem, report = answer(name, Observations.of(hall, cause, number), cause, Path(folder) / "rung")
                if report is None or problem:
                    row[name] = problem
                    continue
                is_good = False
                if cause is not None and report.points is not None:
                    if (name, lost) not in references:
                        references[name, lost] = possible(name, hall, number, lost, Path(folder) / "clean")
                    is_good = error(report.points, hall, lost) <= FACTOR * references[name, lost] + ALLOWANCE
                row[name] = verdict(name, report, cause, is_good)
            rows.append(row)
    return rows


def possible(name: str, hall: Hall, number: int, lost: Sequence[int], folder: Path) -> float:
    """Coordinate error [m] of a program without a cause and without the control points that are lost.

    0 after a failure.
    """
    clean = Observations.of(hall, None, number).without(tuple(set(lost) & set(hall.control.tolist())))
    _, report = answer(name, clean, None, folder)
    return 0.0 if report is None or report.points is None else error(report.points, hall, lost)


def rungs_of(hall: Hall, settings: Mapping[str, Any]) -> Iterator[tuple[Row, Cause | None, int]]:
    """Description, cause and seed number of the noise, for each rung of a hall."""
    for number in range(settings["clean"]):
        yield {"hall": hall.name, "cause": "none", "acts_at": "none"}, None, number
    for number, entry in enumerate(settings["cause"]):
        rng = np.random.default_rng([hall.seed, number])
        station, target = int(rng.integers(len(hall.position))), int(rng.choice(hall.ordinary))
        sizes, unit = list(entry.get("sizes", [1.0])), entry.get("unit", "")
        if unit:
            change = Observations.of(hall, Cause(entry["name"], SMALL_SIZE, station, target), noisy=False)
            report = SMALL_SIZE / np.sqrt(peers.noncentrality(hall, change)) / UNITS[unit]
            sizes.insert(0, float(f"{report * np.sqrt(settings['noncentrality']):.3g}"))
        for step, size in enumerate(sizes, start=1):
            cause = Cause(entry["name"], size * UNITS[unit], station, target)
            place = hall.place(cause)
            where = " ".join(sorted(place.stations) + sorted(place.targets))
            row = {"hall": hall.name, "cause": cause.name, "acts_at": entry["acts_at"], "where": where,
                   "rung": step, "size": size, "unit": unit}  # fmt: skip
            yield row, cause, settings["clean"] + number


def table_of(rows: Sequence[Row]) -> list[Row]:
    """Numbers of rungs with a right verdict for each program: all, by hall, by place of the cause, and by cause."""
    table, names = list[Row](), [name for name in ENTRANTS if name in rows[0]]
    groups = [
        (column, value) for column in ("hall", "acts_at", "cause") for value in dict.fromkeys(r[column] for r in rows)
    ]
    for column, value in [("all", "all"), *groups]:
        group = [r for r in rows if column == "all" or r[column] == value]
        row = {"by": column, "of": value, "rungs": len(group)}
        row |= {name: sum(r[name].startswith(RIGHT) for r in group) for name in names}
        row |= {f"{name}_both": sum(r[name] == RIGHT for r in group) for name in names if name != "check"}
        if column == "all":
            for name in names:
                part = proportion(
                    [r[name].startswith(RIGHT) for r in group], [f"{r['hall']} {r['cause']}" for r in group]
                )
                row |= {f"{name}_low": round(part["low"], 3), f"{name}_high": round(part["high"], 3)}
        table.append(row)
    return table


def run(options: Options) -> RunRecord:
    settings, file = options.config, options.out / "rows.csv"
    if "tables" not in options.arguments:
        names = [name for name in ENTRANTS if name != "gama" or peers.is_installed()]
        if "gama" not in names:
            print_line(f"gama: skipped, because {peers.GAMA} is not on the PATH")
        halls = [Hall.of(entry, settings["noise"], settings["seed"] + k) for k, entry in enumerate(settings["hall"])]
        entries = [(hall, *each) for hall in halls for each in rungs_of(hall, settings)]
        if options.trials is not None:
            entries = [entry for entry in entries if entry[1].get("rung", 1) <= options.trials]
        groups = [list(group) for _, group in groupby(entries, key=lambda entry: (entry[0].name, entry[3]))]
        tasks = [(group[0][0], [cause for _, _, cause, _ in group], group[0][3], names) for group in groups]
        rows = []
        for group, verdicts in zip(groups, run_parallel(rungs, tasks, options.jobs), strict=True):
            for (_, row, _, _), verdict_row in zip(group, verdicts, strict=True):
                rows.append(row | verdict_row)
                print_line("  ".join(str(v) for v in rows[-1].values()))
        write_table(file, rows)
    rows = pd.read_csv(file).convert_dtypes().to_dict("records")
    show_table(options.out / "table.csv", table_of(rows))
    return RunRecord(settings["seed"], options.trials)
