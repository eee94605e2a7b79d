"""Which recordings an examination holds: a plan read from a file, each recording with its own key."""

from __future__ import annotations

import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from .independent import make
from .invented import SETS

LAWS = {"ltsim": tuple(SETS), "independent": tuple(make.SETS)}
"""Sets of laws that unknown physics is drawn from, by simulator: the first where a plan names none."""
Kind = Literal["clean", "single", "unknown", "pair", "mistake"]


@dataclass(frozen=True)
class Case:
    """One recording to be made: what it holds, how strongly, and which of its like it is.

    `laws` is the set that unknown physics is drawn from; name and key do not depend on it. `independent`: made by the
    simulator that shares no formula with ltsim, which has laws of its own.
    """

    seed: int
    kind: Kind
    strength: int
    number: int
    laws: str = "all"
    independent: bool = False

    @property
    def name(self) -> str:
        """A name that tells nothing."""
        return f"R{zlib.crc32(f'{self.seed}/{self.kind}/{self.strength}/{self.number}'.encode()):08x}"

    @property
    def key(self) -> tuple[str | int, ...]:
        """What tells its draws from all others."""
        return ("concealed", self.kind, self.strength, self.number)


def read_plan(path: Path) -> list[Case]:
    """The recordings of a plan, in the order of their names: numbers, strengths and kinds are shuffled by it."""
    plan = tomllib.loads(path.read_text(encoding="utf-8"))
    simulator = plan.get("simulator", "ltsim")
    if simulator not in LAWS:
        raise SystemExit(f"{path}: simulator is {simulator!r}, not one of {', '.join(LAWS)}")
    laws = plan.get("laws", LAWS[simulator][0])
    if laws not in LAWS[simulator]:
        raise SystemExit(f"{path}: laws is {laws!r}, not one of {', '.join(LAWS[simulator])}")
    if simulator == "independent" and {"pair", "mistake"} & set(plan):
        raise SystemExit(f"{path}: the independent simulator makes no pairs and no mistakes")
    cases = [
        Case(int(plan["seed"]), kind, int(strength), number, laws, simulator == "independent")
        for kind in get_args(Kind)
        for strength, count in plan.get(kind, {}).items()
        for number in range(int(count))
    ]
    names = {case.name for case in cases}
    if len(names) < len(cases):
        raise SystemExit(f"{path}: two recordings would have the same name; choose another seed")
    return sorted(cases, key=lambda case: case.name)
