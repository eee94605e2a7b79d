"""A real tracker: calibrated from one set-up, checked on the other, followed over nine epochs.

    python -m experiments 11 [noise] [course] [transfer] [held-out] [lines] [index] [checks] [diagnoses]

Reads ../shared/recordings beside the checkout; writes figures found.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.common import Made, Options, recordings_or_leave, run_steps, show_table, write_figure
from ltsim.adjustment import adjust
from ltsim.calibration import calibrate_network
from ltsim.calibration.files import history_file
from ltsim.calibration.history import History
from ltsim.diagnosis import diagnose
from ltsim.effects import BASELINE
from ltsim.evaluation.two_face import TwoFace, two_face
from ltsim.geometry.polar import from_polar
from ltsim.model.construction import Construction, misalignment
from ltsim.pages.figures.parameters import history_figure
from ltsim.recording import Recording
from ltsim.recording.setup import Noise

from .desy import (
    AUTHORS,
    EPOCHS,
    clean,
    epoch,
    interferometer,
    noise_found,
    set_up,
    snooped,
    variance_factors,
)
from .held_out import FLIPPING, simulated

DEFAULT = "what `calibrate` applies by default"
SIX = misalignment([effect for effect in BASELINE if effect.name in FLIPPING])
LONG = 1.0
UNITS = ("um", "urad across", "urad elevation")
Rows = list[dict[str, object]]


def found_noise(out: Path) -> Noise:
    """The noise of `noise.json`, found anew where the file is absent."""
    file = out / "noise.json"
    if not file.is_file():
        noise(out)
    return Noise(**json.loads(file.read_text())["found"])


def noise(out: Path) -> None:
    found = noise_found()
    text = json.dumps({"found": found.model_dump(), "authors": AUTHORS.model_dump()}, indent=1)
    (out / "noise.json").write_text(text + "\n")
    rows: Rows = []
    for name in EPOCHS:
        kept, dropped = snooped(epoch(name, found))
        adjusted = adjust(kept, misalignment())
        own = variance_factors([adjusted])
        by_authors = adjust(snooped(epoch(name, AUTHORS))[0], misalignment())
        rows.append({"epoch": name, "pointings": len(kept), "chi2/dof": round(adjusted.sigma0**2, 3),
                     "range factor": own[0].round(2), "azimuth factor": own[1].round(2),
                     "elevation factor": own[2].round(2), "chi2/dof authors": round(by_authors.sigma0**2, 3),
                     "pairs left out": "; ".join(f"{d.station} {d.target} {d.observable} w={d.w:.1f}"
                                                 for d in dropped)})  # fmt: skip
    show_table(out / "noise.csv", rows)


@dataclass(frozen=True)
class Compared:
    """The same pairs with the readings as they are and with parameters applied."""

    before: TwoFace
    after: TwoFace

    @property
    def rms_removed(self) -> np.ndarray:
        """(3,) one minus the ratio of the rms: 1 when nothing is left, negative when parameters do harm."""
        return 1.0 - self.after.rms / self.before.rms

    def only(self, pairs: np.ndarray) -> "Compared":
        """The comparison over some of the pairs, (m,) bool."""
        return Compared(self.before.only(pairs), self.after.only(pairs))

    @classmethod
    def of(cls, recording: Recording, construction: Construction, values: np.ndarray) -> "Compared":
        """Half differences before and after parameters (p,) or (n, p) [SI] are applied."""
        return cls(two_face(recording), two_face(recording, construction, values))


def figures(kind: str, compared: Compared) -> dict[str, object]:
    """Rms of the half differences before and after in um and urad, and the share removed."""
    before, after = compared.before.rms * 1e6, compared.after.rms * 1e6
    row: dict[str, object] = {"pairs": f"{len(compared.before)} {kind}"}
    for k, unit in enumerate(UNITS):
        row |= {f"before {unit}": before[k].round(2), f"after {unit}": after[k].round(2)}
        row[f"share {unit.split()[-1]}"] = compared.rms_removed[k].round(3)
    return row


def course(out: Path) -> None:
    found = found_noise(out)
    kept = {name: snooped(epoch(name, found))[0] for name in EPOCHS}
    for label, construction in (("16", misalignment()), ("6", SIX)):
        own = [(name, calibrate_network(kept[name], construction, advise=False)) for name in EPOCHS]
        history = History.of(own)
        told = history_file(history)
        content = told.content()
        (out / f"history_{label}.json").write_text(json.dumps(content, indent=1) + "\n")
        known = [course for course in told.parameters if course.constant.dof]
        if construction is SIX:  # sixteen courses are a table
            write_figure(out / f"history_{label}.svg", history_figure(history.labels, known))
        show_table(out / f"changes_{label}.csv", [
            {"from": c["from"], "to": c["to"], "chi2": round(c["chi2"], 1), "dof": c["dof"],
             "p": f"{c['p_value']:.1e}", "changed": " ".join(c["changed"])}
            for c in [*content["changes"], content["since_first"]]
        ])  # fmt: skip
        show_table(out / f"course_{label}.csv", [
            {"parameter": p["name"], "unit": p["unit"],
             **{name: f"{v:.2f} +- {s:.2f}" for name, v, s in zip(EPOCHS, p["values"], p["sigmas"], strict=True)},
             "mean": round(p["mean"], 2), "spread": round(p["spread"], 2),
             "p constant": f"{p['constant']['p_value']:.1e}"}
            for p in content["parameters"]
        ])  # fmt: skip


METHODS = (
    ("16 parameters", misalignment(), False, False),
    (DEFAULT, misalignment(), False, False),
    ("16 parameters, outliers out", misalignment(), True, False),
    ("16 parameters, outliers out, history of other epochs", misalignment(), True, True),
    ("6 parameters", SIX, False, False),
    ("6 parameters, outliers out", SIX, True, False),
)


def transfer(out: Path) -> None:
    found, every, total = found_noise(out), [], []
    raw = {(name, s): set_up(epoch(name, found), s) for name in EPOCHS for s in (0, 1)}
    good = {key: clean(two_face(r), r) for key, r in raw.items()}
    for method, construction, snoop, informed in METHODS:
        own = {k: calibrate_network(snooped(r, construction)[0] if snoop else r, construction, advise=False)
               for k, r in raw.items()}  # fmt: skip
        compared: dict[tuple[str, int], Compared] = {}
        for name in EPOCHS:
            others = [(f"{k[0]} {k[1]}", c) for k, c in own.items() if k[0] != name]
            history = History.of(others) if informed else None
            for s in (0, 1):
                used = history.informed(own[name, s]) if history else own[name, s]
                values = used.applied[0] if method == DEFAULT else used.values[0]
                one = Compared.of(raw[name, 1 - s], construction, values)
                compared[name, s] = one
                row = figures("clean", one.only(good[name, 1 - s]))
                every.append({"method": method, "epoch": name, "from": s, "to": 1 - s, **row})
        clean_ones = [c.only(good[name, 1 - s]) for (name, s), c in compared.items()]
        for kind, chosen in (("all", list(compared.values())), ("clean", clean_ones)):
            total.append({"method": method, **figures(kind, pooled(chosen)), **medians(chosen)})
    show_table(out / "transfer.csv", every)
    show_table(out / "transfer_summary.csv", [*total, ceiling(raw, good)])


def held_out(out: Path) -> None:
    show_table(out / "held_out_simulated.csv", simulated())


def pooled(compared: list[Compared]) -> Compared:
    def join(parts: list[TwoFace]) -> TwoFace:
        return TwoFace(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("rows", "place", "half")))

    return Compared(join([c.before for c in compared]), join([c.after for c in compared]))


def medians(compared: list[Compared]) -> dict[str, object]:
    share = np.median([c.rms_removed for c in compared], axis=0)
    return {"median share across": share[1].round(3), "median share elevation": share[2].round(3)}


def ceiling(raw: dict[tuple[str, int], Recording], good: dict[tuple[str, int], np.ndarray]) -> dict[str, object]:
    """What the model removes from the very pairs it was fitted to: nothing that transfers can do better."""
    own = [Compared.of(r, misalignment(), calibrate_network(snooped(r)[0], advise=False).values[0]).only(good[k])
           for k, r in raw.items()]  # fmt: skip
    return {"method": "ceiling: 16 parameters on the set-up they were fitted to",
            **figures("clean", pooled(own)), **medians(own)}  # fmt: skip


def lines(out: Path) -> None:
    """Lengths by interferometer against coordinates: the network's, and those of one face of one set-up."""
    found, rows = found_noise(out), []
    gaps: dict[tuple[str, str], list[float]] = {}
    back: list[float] = []
    for name in EPOCHS:
        kept = snooped(epoch(name, found))[0]
        spans = interferometer(name)
        back += there_and_back(spans)
        places = {"network, as read": adjust(kept).state.points,
                  "network, calibrated": adjust(kept, misalignment()).state.points}  # fmt: skip
        for how, points in places.items():
            add_gaps(gaps, how, spans, dict(zip(kept.targets, points, strict=True)))
        for s in (0, 1):
            one, own = set_up(kept, s), calibrate_network(set_up(kept, 1 - s), advise=False)
            for face in (1, 2):
                seen = one.select(one.face == face)
                values = own.values[0]
                for how, points in (("as read", from_polar(seen.readings)),
                                    ("parameters of the other set-up",
                                     own.construction.point(seen.readings, values))):  # fmt: skip
                    cloud = {seen.targets[t]: p for t, p in zip(seen.target, points, strict=True)}
                    add_gaps(gaps, f"one face, {how}", spans, cloud)
    for (how, kind), gap in sorted(gaps.items()):
        values = np.array(gap) * 1e6
        rows.append({"coordinates": how, "lines": kind, "lengths": len(values), "mean um": values.mean().round(2),
                     "rms um": np.sqrt(np.mean(values**2)).round(2),
                     "median |gap| um": np.median(np.abs(values)).round(2)})  # fmt: skip
    half = np.array(back) * 1e6
    rows.append({"coordinates": "interferometer, there less back", "lines": "all", "lengths": len(half),
                 "mean um": half.mean().round(2), "rms um": np.sqrt(np.mean(half**2)).round(2),
                 "median |gap| um": np.median(np.abs(half)).round(2)})  # fmt: skip
    show_table(out / "lines.csv", rows)


def add_gaps(gaps: dict[tuple[str, str], list[float]], how: str, spans: list, points: dict) -> None:
    for span in spans:
        if span.first in points and span.second in points:
            length = float(np.linalg.norm(points[span.second] - points[span.first]))
            long = "over" if span.length > LONG else "under"
            kind = "vertical" if span.line.startswith("Ver") else f"horizontal and diagonal, {long} 1 m"
            gaps.setdefault((how, kind), []).append(length - span.length)


def there_and_back(spans: list) -> list[float]:
    seen, gap = {}, []
    for span in spans:
        key = (span.line[:-2], *sorted((span.first, span.second)))
        if key in seen:
            gap.append(span.length - seen[key])
        seen[key] = span.length
    return gap


def index(out: Path) -> None:
    """Is the vertical index one number? Half differences in elevation: offset and slope of each set-up, one b_z."""
    found, rows = found_noise(out), []
    for name in EPOCHS:
        recording = snooped(epoch(name, found))[0]
        pairs = two_face(recording)
        station = recording.station[pairs.rows[:, 0]]
        design = [-1.0 / pairs.place[:, 0]]
        for s in (0, 1):
            own = station == s
            order = np.zeros(len(pairs))
            order[own] = np.linspace(-1.0, 1.0, int(own.sum()))
            design += [-own.astype(float), -order]
        a, y = np.array(design).T, pairs.half[:, 2] * 1e6
        x, squares = np.linalg.lstsq(a, y)[:2]
        covariance = np.linalg.inv(a.T @ a) * squares[0] / (len(y) - a.shape[1])
        sigma = np.sqrt(np.diag(covariance))
        step = np.array([0.0, -1.0, 0.0, 1.0, 0.0])
        spread = np.sqrt(step @ covariance @ step)
        rows.append({"epoch": name, "index of 1 less 0 urad": f"{step @ x:.2f} +- {spread:.2f}",
                     "drift within 0 urad": f"{2 * x[2]:.2f} +- {2 * sigma[2]:.2f}",
                     "drift within 1 urad": f"{2 * x[4]:.2f} +- {2 * sigma[4]:.2f}"})  # fmt: skip
    show_table(out / "index.csv", rows)


def checks(out: Path) -> None:
    """Three suspects of the diagnoses in every epoch: half difference in range, gaps to the interferometer."""
    found, rows = found_noise(out), []
    for name in EPOCHS:
        recording = epoch(name, found)
        pairs = two_face(recording)
        own = recording.target[pairs.rows[:, 0]] == recording.targets.index("K6")
        points = dict(zip(recording.targets, adjust(recording, misalignment()).state.points, strict=True))
        half = float(pairs.half[own, 0].mean())
        row: dict[str, object] = {"epoch": name, "K6 half difference in range um": round(half * 1e6, 1)}
        for target in ("PQK36_3", "PQK62_10"):
            gaps: dict[tuple[str, str], list[float]] = {}
            add_gaps(gaps, "", [s for s in interferometer(name) if target in (s.first, s.second)], points)
            gap = float(np.mean(np.concatenate(list(gaps.values()))))
            row[f"{target} less interferometer um"] = round(gap * 1e6, 1)
        rows.append(row)
    show_table(out / "checks.csv", rows)


def diagnoses(out: Path) -> None:
    """`ltsim diagnose` on every epoch, with the default noise and with the noise found; half a minute each."""
    rows: Rows = []
    for label, stated in (("default", None), ("found", found_noise(out))):
        for name in EPOCHS:
            content = diagnose(epoch(name, stated)).to_json()
            before, after = content["fit"]["before"], content["fit"]["after"]
            rows.append({"noise": label, "epoch": name, "verdict": content["verdict"],
                         "chi2/dof": f"{before['chi2'] / before['dof']:.2f} to {after['chi2'] / after['dof']:.2f}",
                         "findings": "; ".join(in_words(f) for f in content["findings"])})  # fmt: skip
    show_table(out / "diagnoses.csv", rows)


def in_words(finding: dict) -> str:
    where = finding["where"]
    place = " ".join([*where["stations"], *where["targets"], *where["observables"]])
    sizes = ", ".join(f"{p['name']} {p['value']:.3g} +- {p['sigma']:.2g} {p['unit']}".strip()
                      for p in finding["parameters"])  # fmt: skip
    others = ", ".join(e["effect"] for e in finding["equivalents"])
    chance = f"probability {finding['evidence']['probability']:.2f}"
    return f"{finding['effect']} {place} ({sizes}; {chance}{'; or ' + others if others else ''})".replace("  ", " ")


STEPS = {"noise": noise, "course": course, "transfer": transfer, "held-out": held_out, "lines": lines,
         "index": index, "checks": checks, "diagnoses": diagnoses}  # fmt: skip


def run(given: Options) -> Made:
    """Run the named steps, or all."""
    recordings_or_leave()
    run_steps(given, STEPS)
    return Made()
