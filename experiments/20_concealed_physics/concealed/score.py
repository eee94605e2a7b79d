"""Unseal: compare one diagnosis with the truth of its recording."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from ltsim.recording.recording import OBSERVABLES
from ltsim.units import MILLIMETRE

from .conceal import rigid_error

Row = dict[str, Any]
OVERLAP = 0.5
"""Share of common targets from which a finding on several targets is at the right place."""
HIGH = 0.9
LIMIT = 1.959964
SHOWN = 0.1
"""Share of the strength from which an observable is one that shows a law."""
MOTIONS = (("stand", "station"), ("target", "nest"))
"""Words of what moves, those of one line alike."""
EXPLAINED = ("right_carrier", "right_driver", "right_carrier_or_driver")
"""Asked of laws that say in which words they are told rightly."""
NOISE = ("noise-level", "station-noise", "turbulence")
"""Names under which scatter of unknown cause is rightly told."""


def score(truth: dict[str, Any], folder: Path) -> Row:
    """Everything that is counted of one recording."""
    note = json.loads((folder / "status.json").read_text(encoding="utf-8"))
    row: Row = {k: truth[k] for k in ("name", "kind", "strength", "number", "stations", "faces", "pointings")}
    row["truth"] = " + ".join(e["effect"] for e in truth["effects"])
    row["truth_detail"] = " + ".join(e["text"] for e in truth["effects"])
    row["excluded"] = json.dumps(truth.get("excluded", {}))
    row.update(seconds=note["seconds"], exit=note["exit"], complaint=note["complaint"])
    if note["exit"] != 0:
        return row
    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    findings = found["findings"]
    row["search_p_value"] = found["global_test"]["search_p_value"]
    row["chi2_p_value"] = found["global_test"]["p_value"]
    row["found"] = found["verdict"] == "mismatch"
    row["first"] = findings[0]["effect"] if findings else ""
    row["answer"] = " + ".join(f["effect"] for f in findings)
    row["probability"] = findings[0]["evidence"]["probability"] if findings else np.nan
    row["summary"] = found["summary"]
    row["held_out_before"] = found["fit"]["before"]["held_out_rms"]
    row["held_out_after"] = found["fit"]["after"]["held_out_rms"]
    row["error_um"] = _target_error(truth, folder / "targets.csv")
    row["told_um"], row["ordinary_um"] = truth["told_um"], truth["ordinary_um"]
    row["told_as_one"] = len(findings) == 1
    row["carrier"], row["driver"] = (findings[0].get(k, "") if findings else "" for k in ("carrier", "driver"))
    row["stated"] = " ".join(f"{e['effect']}:{e['probability']:.2f}" for f in findings[:1] for e in f["equivalents"])
    row["right"] = row["first"] in {e["effect"] for e in truth["effects"]} | _rightly(truth)
    match truth["kind"]:
        case "single" | "mistake":
            row.update(_named(truth["effects"][0], findings[0] if findings else None))
            row["also_found"] = max(len(findings) - 1, 0)
        case "unknown":
            row.update(_unknown(truth, findings))
        case "pair":
            row.update(_pair(truth["effects"], findings))
    return row


def _rightly(truth: dict[str, Any]) -> set[str]:
    """What an invented law is rightly called, a law of the noise noise; nothing where none was hidden."""
    if truth["kind"] != "unknown":
        return set()
    return {"unknown", *(NOISE if truth["effects"][0].get("words", {}).get("carrier") == "noise" else ())}


def _target_error(truth: dict[str, Any], file: Path) -> float:
    with file.open(encoding="utf-8") as lines:
        rows = {r["target"]: [float(r[f"{a}_mm"]) for a in "xyz"] for r in csv.DictReader(lines)}
    names = [name for name in truth["targets_mm"] if name in rows]
    points = np.array([rows[name] for name in names]) * MILLIMETRE
    return rigid_error(points, np.array([truth["targets_mm"][name] for name in names]) * MILLIMETRE)


def _named(effect: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Name, place and parameters of one effect against one finding."""
    if finding is None:
        return {"named_first": False, "named": False}
    first = finding["effect"] == effect["effect"]
    named = first or any(e["effect"] == effect["effect"] for e in finding["equivalents"][:3])
    where = finding["where"]
    stations = _same_place(set(where["stations"]), set(effect["stations"]), first)
    targets = _same_place(set(where["targets"]), set(effect["targets"]), first)
    observables = _same_observables(set(where["observables"]), set(effect["observables"]), first)
    row: Row = {"named_first": first, "named": named, "right_stations": stations, "right_targets": targets}
    row.update(right_observables=observables, right_place=stations and targets and observables)
    if first:
        row.update(_coverage(effect, finding))
    return row


def _same_place(found: set[str], true: set[str], first: bool) -> bool:
    """Equal, of several names half; an effect named as an equivalent only may be less confined than the finding."""
    if not first and (not found or not true):
        return True
    if len(true) < 2:
        return found == true
    return len(found & true) >= OVERLAP * len(found | true)


def _same_observables(found: set[str], true: set[str], first: bool) -> bool:
    """Equal; where the effect was named as an equivalent only, the finding's own may be others that share one."""
    return found == true or (not first and (not found or not true or bool(found & true)))


def _coverage(effect: dict[str, Any], finding: dict[str, Any]) -> Row:
    """Parameters that were estimated, and how many of their 95 % intervals hold the truth."""
    true = {p["name"]: p["value"] for p in effect["parameters"]} | effect["shape"]
    if "table=(" in effect["text"] and "table=()" not in effect["text"]:  # a table has no parameters to be right about
        true = {}
    misses = {
        p["name"]: (p["value"] - true[p["name"]]) / p["sigma"]
        for p in finding["parameters"]
        if p["name"] in true and p["sigma"] > 0
    }
    return {
        "parameters": len(misses),
        "covered": sum(abs(m) <= LIMIT for m in misses.values()),
        "misses": " ".join(f"{name}:{m:.1f}" for name, m in misses.items()),
    }


def _unknown(truth: dict[str, Any], findings: list[dict[str, Any]]) -> Row:
    effect, nearest = truth["effects"][0], truth["nearest_known"]
    row: Row = {"nearest_known": nearest["effect"], "nearest_share": nearest["share"], "called_unknown": False}
    row.update(law=effect["parameters"][0]["name"], observable_right=False, wrong_name=False)
    row["law"] = effect["text"].partition("law='")[2].partition("'")[0]
    row.update({f"true_{what}": told for what, told in effect.get("words", {}).items()})
    if "told_as" in effect:
        row.update(_explained(effect["told_as"], findings[0] if findings else None))
    if not findings:
        return row
    first = findings[0]
    row["called_unknown"] = first["effect"] in _rightly(truth)
    where = first["where"]
    row["shown"] = " ".join(sorted(_shown(effect)))
    row["observable_right"] = row["called_unknown"] and (_moves_alike(effect, first) or _told(first) == _shown(effect))
    row["right_covariates"] = row["called_unknown"] and bool(set(where["covariates"]) & set(effect["covariates"]))
    row["wrong_name"] = first["known"] and not row["called_unknown"] and first["evidence"]["probability"] > HIGH
    row["where"] = f"{where['observables']} {where['covariates']} {where['stations']}"
    return row


def _shown(effect: dict[str, Any]) -> set[str]:
    """The observables in which a law shows, by what each has in its strength."""
    whole = sum(effect["strengths"])
    return {name for name, part in zip(OBSERVABLES, effect["strengths"], strict=True) if part > SHOWN * whole}


def _told(finding: dict[str, Any]) -> set[str]:
    """The observables that a finding tells, all where it names none; of the noise those that scatter beyond doubt."""
    scatter = {p["name"].removeprefix("noise-") for p in finding["parameters"] if p["value"] > LIMIT * p["sigma"]}
    return set(finding["where"]["observables"]) or scatter & set(OBSERVABLES) or set(OBSERVABLES)


def _moves_alike(effect: dict[str, Any], finding: dict[str, Any]) -> bool:
    """Whether a constant or a motion is told as itself: in which readings it shows is then for the network to say."""
    true, told = effect.get("words", {}).get("carrier", ""), finding.get("carrier", "")
    words = effect.get("told_as", {}).get("carrier") or next((m for m in MOTIONS if any(w in true for w in m)), (true,))
    named = [word for word in words if word not in ("", *OBSERVABLES)]
    return told not in OBSERVABLES and any(word in told for word in named)


def _explained(told_as: dict[str, Any], finding: dict[str, Any] | None) -> Row:
    """Whether carrier and driver are told in one of the words that are right for them."""
    if finding is None:
        return dict.fromkeys(EXPLAINED, False)
    known = finding["effect"] != "unknown"
    carrier = "noise" if finding["effect"] in NOISE else "" if known else finding.get("carrier", "")
    words = set(re.split(r"[^a-z_]+", finding.get("driver", "").lower())) | set(finding["where"]["covariates"])
    right_carrier = any(word in carrier for word in told_as["carrier"])
    right_driver = not known and bool(words & set(told_as["driver"]))
    return dict(zip(EXPLAINED, (right_carrier, right_driver, right_carrier or right_driver), strict=True))


def _pair(effects: list[dict[str, Any]], findings: list[dict[str, Any]]) -> Row:
    """Each effect needs a finding of its own that names it first, or states it as an equivalent."""

    def count(strict: bool) -> int:
        free, hits = list(findings), 0
        for effect in effects:
            fits = [f for f in free if _hit(effect, f, strict)]
            if fits:
                free.remove(fits[0])
                hits += 1
        return hits

    return {"pair_named": count(True), "pair_stated": count(False), "findings": len(findings)}


def _hit(effect: dict[str, Any], finding: dict[str, Any], strict: bool) -> bool:
    names = [finding["effect"], *([] if strict else [e["effect"] for e in finding["equivalents"][:3]])]
    return effect["effect"] in names
