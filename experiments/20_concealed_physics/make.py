"""Recordings with concealed causes, and the truth in a separate file with its checksum (sha256)."""

import hashlib
import json
import tomllib
import zlib
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.optimize import brentq

from .hall import LENGTH_SIGMA, Draw, Hall, draw_hall
from .law import Cause, carriers, laws_of
from .laws.catalogue import KNOWN
from .network import Network
from .recording import write_recording
from .tracker import Change

RECORDINGS, TRUTH, SEAL = "recordings", "truth.json", "SEAL"
TRIES = 40
ABSURD = {"reading": 300e-6, "target": 600e-6, "station": 600e-6, "turn": 300e-6, "constants": 300e-6, "variance": 50.0,
          "lengths": 2e-3}  # fmt: skip
"""Limits [m, rad] of each part of a change; draws with larger changes are excluded, because they would be obvious."""
SMALLEST_DECADE, LARGEST_DECADE = -4.0, 4.0
"""Decimal logarithms of the smallest and largest size in the search for the required strength."""


@dataclass(frozen=True)
class Case:
    """Recording of a plan: kind (`clean`, `catalogued`, `unknown`), hall, law and strength."""

    seed: int
    kind: str
    hall: str
    law: str
    strength: int
    number: int
    laws: tuple[str, ...]

    @classmethod
    def of(cls, truth: dict[str, Any]) -> Self:
        """Case of a recording from its truth; it has the same random numbers."""
        values = {field.name: truth[field.name] for field in fields(cls)}
        return cls(**values | {"laws": tuple(truth["laws"])})

    @property
    def words(self) -> str:
        """Text that identifies the random numbers of the case."""
        return f"{self.seed}/{self.kind}/{self.hall}/{self.law}/{self.strength}/{self.number}"

    @property
    def name(self) -> str:
        """Name of the recording: a hash, which contains no information about the cause."""
        return f"R{zlib.crc32(self.words.encode()):08x}"

    def stream(self, purpose: str) -> Draw:
        """Random generator of the case for one purpose, such as the hall with its law, or the noise."""
        return np.random.default_rng([self.seed, *f"{purpose}/{self.words}".encode()])


def read_plan(path: Path) -> list[Case]:
    """Cases of a plan in the order of their names, so that the first cases are a random sample.

    In the file, ``clean`` and ``clean-large`` are numbers of recordings; the other tables have the number of recordings
    of each law by strength.
    """
    with path.open("rb") as file:
        plan = tomllib.load(file)
    groups, cases = tuple(plan["laws"]), []
    for key in (k for k in plan if k not in ("seed", "laws")):
        kind, _, size = key.partition("-")
        names = {"clean": [""], "catalogued": list(KNOWN), "unknown": list(laws_of(groups))}[kind]
        counts = plan[key] if isinstance(plan[key], dict) else {"0": plan[key]}
        for strength, count in counts.items():
            cases += [Case(plan["seed"], kind, size or "hall", law, int(strength), k, groups)
                      for law in names for k in range(count)]  # fmt: skip
    return sorted(cases, key=lambda c: c.name)


def make(cases: Sequence[Case], work_folder: Path, jobs: int = 1) -> str:
    """Checksum (sha256) of the truth, after recordings, truth and checksum have been written to a folder."""
    with ProcessPoolExecutor(jobs) as pool:
        made = list(pool.map(make_recording, cases, [work_folder / RECORDINGS] * len(cases), chunksize=4))
    truth = json.dumps({t["name"]: t for t in made}, indent=1) + "\n"
    seal = hashlib.sha256(truth.encode()).hexdigest()
    (work_folder / TRUTH).write_text(truth, encoding="utf-8")
    (work_folder / SEAL).write_text(f"{seal}  {TRUTH}\n", encoding="utf-8")
    return seal


def make_recording(case: Case, folder: Path) -> dict[str, Any]:
    """Truth of one recording, which is written to `folder`."""
    excluded: Counter[str] = Counter()
    hall, network, cause, change = draw_case(case, excluded)
    rng = case.stream("noise")
    noise = rng.standard_normal((hall.n, 3)), rng.standard_normal(len(hall.bars))
    spread = hall.sigma if change.variance is None else hall.sigma * np.sqrt(1.0 + change.variance)
    wrong = 0.0 if change.lengths is None else change.lengths
    readings = hall.pointings.readings(change) + spread * noise[0]
    write_recording(hall, readings, hall.lengths + LENGTH_SIGMA * noise[1] + wrong, folder / case.name)
    largest = {name: float(np.abs(part).max()) for name, part in change.parts.items()}
    strength = {"strengths": network.strengths(change).tolist(), "largest": largest, "carriers": carriers(change)}
    modelled_changes = {"clean": (), "catalogued": cause.parts, "unknown": (change,)}[case.kind]
    return {
        "name": case.name,
        **{key: getattr(case, key) for key in ("seed", "laws", "kind", "hall", "law", "strength", "number")},
        "hidden": strength | cause.truth if cause.parts else None,
        "stations": len(hall.stations),
        "unknowns": network.design.shape[1],
        "pointings": hall.n,
        "told_um": network.target_error(noise, change, modelled_changes),
        "plain_um": network.target_error(noise, change),
        "excluded": dict(excluded),
        "targets_mm": dict(zip(hall.targets, (1e3 * hall.pointings.points).tolist(), strict=True)),
    }


def draw_case(case: Case, excluded: Counter[str]) -> tuple[Hall, Network, Cause, Change]:
    """Hall, network, cause and change with the required strength; `excluded` counts excluded draws by reason."""
    rng = case.stream("hall")
    for _ in range(TRIES):
        hall = draw_hall(rng, case.hall)
        if case.kind == "clean":
            return hall, Network.of(hall), Cause(), Change()
        try:
            cause = (KNOWN if case.kind == "catalogued" else laws_of(case.laws))[case.law](hall, rng)
        except LookupError:
            excluded["the hall lacks what the law needs"] += 1
            continue
        network, whole = Network.of(hall), cause.change
        size = _size_of_strength(network, whole, case.strength)
        change = whole.scaled(size)
        if size and all(np.abs(part).max() < ABSURD[k] for k, part in change.parts.items()):
            return hall, network, replace(cause, values=size * cause.values), change
        excluded["absurdly large" if size else "the network hides it"] += 1
    raise RuntimeError(f"'{case.law}' has the strength {case.strength} at a plausible size in none of {TRIES} halls")


def _size_of_strength(network: Network, change: Change, strength: float) -> float:
    """Factor at which a change has the given strength; 0 if it exceeds 10 to the power `LARGEST_DECADE`."""

    def miss(decade: float) -> float:
        return float(np.log(max(network.strengths(change.scaled(10**decade)).sum(), 1e-30) / strength))

    if miss(LARGEST_DECADE) <= 0.0:
        return 0.0
    return float(10 ** brentq(miss, SMALLEST_DECADE, LARGEST_DECADE, xtol=1e-4))
