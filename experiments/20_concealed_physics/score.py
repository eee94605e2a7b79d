"""One answer against the truth of its recording. RULES.md says in words what each function here counts as right."""

import csv
import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from .law import OBSERVABLES
from .make import Case, drawn
from .measure import Model

Row = dict[str, Any]
LIMIT = 1.959964
SHOWN = 0.1
"""Share of the strength from which an observable is one that shows a law."""
OVERLAP = 0.5
"""Share of common names from which several stations or targets are the right ones."""
RIGHT = 0.75
"""Share of the true signal from which a model describes it rightly; half the size takes as much."""
HIGH = 0.9
GEOMETRY = {"distance", "azimuth", "elevation", "incidence", "height", "place", "face"}
"""What the pointing itself says: a constant or a motion shows by these, so they need not be told beside it."""
SAME = {"hall_temperature_c": "temperature"}
AS_UNKNOWN = {"noise": ("noise-level", "station-noise", "turbulence"), "gauge": ("gauge-scale", "gauge-shape")}
"""Names of the catalogue under which a law of this carrier is rightly told, besides unknown."""
WORDS = {
    "station": ("stand", "station"),
    "targets": ("target", "nest"),
    "gauge": ("gauge", "length"),
    "noise": ("noise",),
}
"""What a carrier may be called, besides the names of the tracker's constants."""


def score_one(truth: dict[str, Any], folder: Path) -> Row:
    """Everything that is counted of one recording."""
    row: Row = {k: truth[k] for k in ("name", "kind", "hall", "law", "strength", "told_um", "plain_um")}
    status = json.loads((folder / "status.json").read_text(encoding="utf-8"))
    row |= {"seconds": status["seconds"], "answered": (folder / "diagnosis.json").is_file()}
    if not row["answered"]:
        return row
    answer = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    findings, test, hidden = answer["findings"], answer["global_test"], truth["hidden"]
    row |= {"found": answer["verdict"] == "mismatch", "p_value": test.get("search_p_value", test["p_value"])}
    row |= {"answer": " + ".join(f["effect"] for f in findings), "one_finding": len(findings) == 1}
    row["error_um"] = target_error(truth["targets_mm"], folder / "targets.csv")
    stated = [(f.get("evidence", {}).get("probability"), f) for f in findings]
    row["stated"] = [(p, right(truth, f)) for p, f in stated if p is not None]
    first = findings[0] if findings else None
    if truth["kind"] == "catalogued":
        row |= _named(truth, first)
    if truth["kind"] == "unknown":
        row |= _recognised(hidden, first)
    if truth["kind"] != "clean":
        row |= _measured(truth, first, folder)
    return row


def _measured(truth: dict[str, Any], finding: dict[str, Any] | None, folder: Path) -> Row:
    """Share of the true signal that is taken, told rightly, coefficients over those of the truth, law of the list."""
    _, network, _, change = drawn(Case.of(truth), Counter())
    model, hidden, noise = Model.read(folder, network), truth["hidden"], change.variance is not None
    row: Row = {"share_taken": model.share(network, change), "told_rightly": False}
    if "law" in model.notes:
        row["law_right"] = model.notes["law"] == truth["law"]
    if finding is None:
        return row
    row["place_right"] = place_right(truth, finding)
    row["observable_shown"] = (
        set(hidden.get("observables", ())) == set(finding["where"].get("observables", ())) != set()
        or observable_right(hidden, finding)
        or ("gauge" not in hidden["carriers"] and model.observables(network, SHOWN, noise=noise) == _shown(hidden))
    )
    row["told_rightly"] = row["share_taken"] >= RIGHT and row["place_right"] and row["observable_shown"]
    if model.notes.get("coefficients"):
        row["coefficients"] = model.notes["coefficients"] / hidden["coefficients"]
    return row


def place_right(truth: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Stations, targets and instruments of an effect; stations and instruments of a law, whatever it is called."""
    keys = ("stations", "targets") if truth["kind"] == "catalogued" else ("stations", "instruments")
    pairs = [(set(truth["hidden"][key]), set(finding["where"].get(key, []))) for key in keys]
    several = truth["kind"] == "unknown"
    return all(_alike(true, told) or (several and len(true) > 1 and not told) for true, told in pairs)


def right(truth: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Whether a finding says what was hidden: name and place of an effect, or unknown with the observable of a law."""
    if truth["kind"] == "clean":
        return False
    if truth["kind"] == "catalogued":
        return finding["effect"] == truth["law"] and same_place(truth["hidden"], finding, strict=True)
    return is_unknown(truth["hidden"], finding) and observable_right(truth["hidden"], finding)


def target_error(true_mm: dict[str, list[float]], file: Path) -> float | None:
    """Error [um, rms] of the targets after the best rigid fit; None where there are none."""
    if not file.is_file():
        return None
    with file.open(encoding="utf-8") as lines:
        told = {r["target"]: [float(r[f"{a}_mm"]) for a in "xyz"] for r in csv.DictReader(lines)}
    names = [name for name in true_mm if name in told]
    if len(names) < 4:
        return None
    points, truth = (np.array([source[n] for n in names]) for source in (told, true_mm))
    a, b = points - points.mean(axis=0), truth - truth.mean(axis=0)
    gap = Rotation.align_vectors(b, a)[0].apply(a) - b
    return float(1e3 * np.sqrt((gap**2).sum(axis=1).mean()))


def _named(truth: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Name, place and parameters of an effect against the first finding."""
    if finding is None:
        return {"named_first": False, "named": False}
    first = finding["effect"] == truth["law"]
    stated = any(e["effect"] == truth["law"] for e in finding.get("equivalents", [])[:3])
    row: Row = {"named_first": first, "named": first or stated}
    if row["named"]:
        row["place"] = same_place(truth["hidden"], finding, strict=first)
    if first:
        true = {p["name"]: p["value"] for p in truth["hidden"]["parameters"]} | truth["hidden"]["shape"]
        told = [p for p in finding.get("parameters", []) if p["name"] in true and p["sigma"] > 0]
        row["parameters"] = [bool(abs(p["value"] - true[p["name"]]) <= LIMIT * p["sigma"]) for p in told]
    return row


def same_place(hidden: dict[str, Any], finding: dict[str, Any], *, strict: bool) -> bool:
    """Stations, targets and observables alike; an effect that is stated beside another may be less confined."""
    true = {key: set(hidden[key]) for key in ("stations", "targets", "observables")}
    told = {key: set(finding["where"].get(key, [])) for key in true}
    sets = [(true[key], told[key]) for key in ("stations", "targets")]
    loose = not strict and (not true["observables"] or not told["observables"])
    observables = loose or told["observables"] == true["observables"]
    return observables and all(_alike(a, b) or (not strict and (not a or not b)) for a, b in sets)


def _alike(true: set[str], told: set[str]) -> bool:
    return true == told if len(true) < 2 else len(true & told) >= OVERLAP * len(true | told)


def _recognised(hidden: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Whether a law is told as unknown, with its observable, its place and what it follows."""
    asked = ("unknown", "observable", "all_covariates", "outside", "covariates_or_outside", "place", "wrong_name")
    if finding is None:
        return dict.fromkeys(asked, False)
    unknown = is_unknown(hidden, finding)
    observable = unknown and observable_right(hidden, finding)
    outside = observable and (finding.get("outside", False) or not _covariates(finding))
    covariates = observable and not finding.get("outside", False) and covariates_right(hidden, finding)
    wrong = not unknown and finding.get("evidence", {}).get("probability", 0.0) > HIGH
    place = unknown and place_right({"kind": "unknown", "hidden": hidden}, finding)
    values = (unknown, observable, covariates, outside and not covariates, covariates or outside, place, wrong)
    told_as = {f"told_{key}": finding.get(key, "") for key in ("carrier", "driver")}
    return told_as | dict(zip(asked, values, strict=True))


def is_unknown(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Called unknown; a law of the noise or of the known lengths may bear the general name."""
    return finding["effect"] in {"unknown", *(n for c in hidden["carriers"] for n in AS_UNKNOWN.get(c, ()))}


def observable_right(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """The observables in which the law shows are told, or the constant or motion that it turns or moves."""
    tokens = set(re.findall(r"[a-z]+", finding.get("carrier", "").lower()))
    tokens |= {token.rstrip("s") for token in tokens}
    for carrier in hidden["carriers"]:
        if carrier in WORDS and (tokens & set(WORDS[carrier]) or finding["effect"] in AS_UNKNOWN.get(carrier, ())):
            return carrier != "noise" or _told(finding) == _shown(hidden)
        if carrier not in OBSERVABLES and not (set(carrier.split("-")) - {"cos", "sin"}) - tokens:
            return True
    return "gauge" not in hidden["carriers"] and _told(finding) == _shown(hidden)


def _shown(hidden: dict[str, Any]) -> set[str]:
    """The observables in which a law shows, by what each has in its strength."""
    parts = hidden["strengths"][:3]
    return {name for name, part in zip(OBSERVABLES, parts, strict=True) if part > SHOWN * sum(hidden["strengths"])}


def _told(finding: dict[str, Any]) -> set[str]:
    """The observables of a finding, all where it names none; of noise those that scatter beyond their uncertainty."""
    found = finding.get("parameters", [])
    scatter = {p["name"].removeprefix("noise-") for p in found if p["value"] > LIMIT * p["sigma"]} & set(OBSERVABLES)
    return set(finding["where"].get("observables", [])) or scatter or set(OBSERVABLES)


def _covariates(finding: dict[str, Any]) -> set[str]:
    return {SAME.get(name, name) for name in finding["where"].get("covariates", [])}


def covariates_right(hidden: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Each covariate that the law follows is told, and none besides what may be."""
    told, follows = _covariates(finding), [{SAME.get(x, x) for x in item} for item in hidden["follows"]]
    moving = any(c not in (*OBSERVABLES, "noise") for c in hidden["carriers"])
    carried = finding.get("carrier", "") not in ("", "noise", *OBSERVABLES)
    needed = [item for item in follows if not (carried and item <= GEOMETRY and len(follows) > 1)]
    allowed = set().union(*follows, hidden["may"], GEOMETRY if moving and not carried else ())
    return all(told & item for item in needed) and told <= {SAME.get(x, x) for x in allowed}
