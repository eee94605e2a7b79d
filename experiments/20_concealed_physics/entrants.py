"""Who answers: ltsim, what else a user would take, or any program; each is given the folder of a recording alone."""

import contextlib
import io
import json
import shlex
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from .make import RECORDINGS

STATUS = "status.json"
LEVEL = 0.05
LIMIT_S = 900.0
HUBER, HUBER_ROUNDS = 1.5, 8


def ltsim(recording: Path, out: Path) -> None:
    """`ltsim diagnose`, without the repeated search on held-out readings: it changes nothing that is told."""
    import numpy as np

    import ltsim as lt

    from .measure import Model

    given = lt.read(str(recording))
    diagnosis = lt.diagnose(given, held_out=False)
    lt.write(diagnosis, out)
    change, factors = diagnosis.modelled_reading_change(given), diagnosis.variance_factors
    notes = {"coefficients": diagnosis.n_effect_coefficients}
    Model(np.asarray(change), factors, diagnosis.modelled_length_change(given), notes).write(out)


def ideal(recording: Path, out: Path) -> None:
    """The ideal observer: it is told the hall without noise and the list of laws, but not what was drawn."""
    from .ideal import answer as ideal_answer

    ideal_answer(recording, out)


def plain(recording: Path, out: Path) -> None:
    """The calibration of the instrument in a network adjustment, and its global test."""
    _calibrated(recording, out, robust=False)


def snooping(recording: Path, out: Path) -> None:
    """The same with data snooping (Baarda 1968): readings that fail are left out, each tested again at the end."""
    _calibrated(recording, out, robust=True)


def huber(recording: Path, out: Path) -> None:
    """The same by a robust estimator: Huber's function at 1.5 sigma (1964), by iterated weights of single readings."""
    import numpy as np

    from ltsim.adjustment import adjust
    from ltsim.physics.model.construction import misalignment_construction

    read = _calibrated(recording, out, robust=False)
    adjustment = adjust(read, misalignment_construction())
    for _ in range(HUBER_ROUNDS - 1):
        size = np.abs(np.nan_to_num(adjustment.residuals / read.reading_sigmas())) / HUBER
        adjustment = adjust(
            read, misalignment_construction(), sigma=read.reading_sigmas() * np.sqrt(np.maximum(size, 1.0))
        )
    _targets(out, read.targets, 1e3 * adjustment.state.target_points)


def gama(recording: Path, out: Path) -> None:
    """GNU Gama's `gama-local`, by Cholesky: its default loses points. Constants and tilts are the calibration's."""
    import numpy as np
    from defusedxml import ElementTree
    from scipy.stats import chi2

    import ltsim as lt
    from ltsim.calibration.correct import corrected_readings
    from ltsim.geometry.polar import from_polar, swap_front_and_raw, to_polar
    from ltsim.geometry.rigid import rotation_about_z

    read = lt.read(str(recording))
    adjustment = lt.calibrate(read, advise=False)
    ideal = corrected_readings(read, adjustment.construction, adjustment.estimates[read.instrument])
    upright = np.stack(
        [rotation_about_z(-np.arctan2(r[1, 0], r[0, 0])) @ r for r in adjustment.adjustment.state.station_rotations]
    )
    local = from_polar(swap_front_and_raw(ideal, read.face))
    level = swap_front_and_raw(to_polar(np.einsum("nij,nj->ni", upright[read.station], local)), read.face)
    stations = {name: s.model_copy(update={"levelled": True}) for name, s in read.setup.stations.items()}
    setup = read.setup.model_copy(update={"stations": stations})
    lt.write(read.replace(setup=setup, readings=level), out / "network.gkf", format="gama-local")
    words = [str(out / "network.gkf"), "--algorithm", "cholesky", "--xml", str(out / "adjusted.xml"), "--cov-band", "0"]
    subprocess.run([NEEDED["gama"], *words], check=True, timeout=LIMIT_S, capture_output=True)
    adjusted = ElementTree.parse(out / "adjusted.xml").getroot()
    points = {p[0].text: [1e3 * float(c.text) for c in p[1:]] for p in adjusted.iterfind(".//{*}adjusted/{*}point")}
    _targets(out, read.targets, [points[name] for name in read.targets])
    squares, dof = (float(adjusted.findtext(f".//{{*}}{tag}")) for tag in ("sum-of-squares", "degrees-of-freedom"))
    _verdict(out, float(chi2.sf(squares, dof)))


def _calibrated(recording: Path, out: Path, *, robust: bool) -> Any:
    """Targets of the calibration, and the global test before anything is left out; such programs tell no cause."""
    import ltsim as lt

    read = lt.read(str(recording))
    adjustment = lt.calibrate(read, advise=False, robust=robust)
    adjustment.to_dataframe("targets").to_csv(out / "targets.csv", index=False)
    _verdict(out, float((lt.calibrate(read, advise=False) if robust else adjustment).fit.p_value))
    return read


def _verdict(out: Path, p: float) -> None:
    verdict = {"verdict": "mismatch" if p < LEVEL else "consistent", "global_test": {"p_value": p}, "findings": []}
    (out / "diagnosis.json").write_text(json.dumps({"format": "ltsim-diagnosis/1"} | verdict) + "\n", encoding="utf-8")


def _targets(out: Path, names: Sequence[str], places_mm: Any) -> None:
    rows = [f"{name},{x:.6f},{y:.6f},{z:.6f}" for name, (x, y, z) in zip(names, places_mm, strict=True)]
    (out / "targets.csv").write_text("\n".join(["target,x_mm,y_mm,z_mm", *rows]) + "\n", encoding="utf-8")


PROGRAMS: tuple[Callable[[Path, Path], None], ...] = (ltsim, plain, snooping, huber, gama, ideal)
ENTRANTS = {program.__name__: program for program in PROGRAMS}
NEEDED = {"gama": "gama-local"}  # programs that have to be on the PATH


def answer(work: Path, name: str, command: str = "", jobs: int = 1) -> bool:
    """Let an entrant answer all recordings that it has not answered yet, into `answers/NAME`; whether it could."""
    program = NEEDED.get(name, "") if not command else ""
    if program and shutil.which(program) is None:
        print(f"{name}: skipped, {program} is not on the PATH")
        return False
    folders = sorted(f for f in (work / RECORDINGS).iterdir() if f.is_dir())
    open_folders = [f for f in folders if not (work / "answers" / name / f.name / STATUS).is_file()]
    with ProcessPoolExecutor(jobs) as pool:
        list(
            pool.map(
                partial(_answer_recording, answers=work / "answers" / name, name=name, command=command), open_folders
            )
        )
    return True


def _answer_recording(recording: Path, answers: Path, name: str, command: str) -> None:
    out, start, note = answers / recording.name, time.perf_counter(), ""
    out.mkdir(parents=True, exist_ok=True)
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            if command:
                words = [w.format(recording=recording, out=out) for w in shlex.split(command)]
                subprocess.run(words, check=True, timeout=LIMIT_S, capture_output=True)
            else:
                ENTRANTS[name](recording, out)
        except Exception as problem:  # an entrant that fails has not answered; the others go on
            note = f"{type(problem).__name__}: {problem}"
    content: dict[str, Any] = {"seconds": time.perf_counter() - start, "problem": note}
    (out / STATUS).write_text(json.dumps(content) + "\n", encoding="utf-8")
