"""Catalogue of effects, built-in and from installed packages, and the description (card) of each.

A package adds effects by entry points of the group `ltsim.effects`, each naming a class:

    [project.entry-points."ltsim.effects"]
    cable-drag = "my_package.cable_drag:CableDrag"

Packages are searched when the catalogue is first read beyond the built-in effects, not when ltsim is imported.

A card is the docstring of the effect's class, or of its file. Its first line is the title, a colon and the cause; then
come the law, with its sign, and a paragraph for each of `PARTS`.
"""

import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Self

from ltsim.core.errors import ModelError, unknown_name
from ltsim.core.units import FACTOR
from ltsim.physics.effects.effect import Effect, Stage

GROUP = "ltsim.effects"
SHIPPED = "ltsim"
SESSION = "this session"
ADDED = "installed"
"""Group of the effects from installed packages."""
NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
PARTS = ("Size", "Like", "Separate by", "Valid", "Source", "Status")
"""Parts of a catalogue entry: sizes in a good and in a bad instrument or room; effects that leave similar residuals,
with two correlations of the residuals in the reference workshop, one face and two faces; the measurement that
distinguishes it from these; domain in which the law holds; literature; how the law was validated.
"""
_PART = re.compile(rf"^({'|'.join(PARTS)}): ", re.MULTILINE)


@dataclass(frozen=True)
class Card:
    """Catalogue entry of a physical cause."""

    title: str
    cause: str
    """Name (`title`) and description (`cause`) of the physical cause."""
    law: str
    """Equation of the effect with its sign, line by line as in the docstring."""
    texts: tuple[str, ...]
    """Texts of the sections in `PARTS`, in that order."""

    @classmethod
    def read(cls, text: str) -> Self:
        """Card parsed from a docstring.

        Raises ModelError that names a part that is missing, repeated or out of order.
        """
        head, _, rest = inspect.cleandoc(text).partition("\n\n")
        title, colon, cause = " ".join(head.split()).rstrip(".").partition(": ")
        if not colon or not cause:
            raise ModelError(f"a card begins with 'Title: what happens.', found {head.partition(chr(10))[0]!r}")
        pieces = _PART.split(rest)
        if tuple(pieces[1::2]) != PARTS:
            pieces_in_bold = ", ".join(pieces[1::2]) or "none"
            raise ModelError(f"a card has the parts {', '.join(PARTS)} in this order, found {pieces_in_bold}")
        law, *sections = (piece.strip() for piece in pieces[::2])
        for name, part in zip(("law", *PARTS), (law, *sections), strict=True):
            if not part:
                raise ModelError(f"the part {name} of a card is empty")
        return cls(title, cause, law, tuple(" ".join(part.split()) for part in sections))

    def parts(self) -> tuple[tuple[str, str], ...]:
        """Pairs (name, text) of the parts after the law."""
        return tuple(zip(PARTS, self.texts, strict=True))


@cache
def card_of(kind: type) -> Card:
    """Card of an effect class; raises ModelError if neither the class nor its module has a complete one."""
    doc = kind.__dict__.get("__doc__") or ""
    text = doc if _PART.search(inspect.cleandoc(doc)) else sys.modules[kind.__module__].__doc__
    try:
        return Card.read(text or "")
    except ModelError as problem:
        raise ModelError(f"{kind.__module__}.{kind.__name__}: {problem}") from None


@dataclass(frozen=True)
class Listed:
    """Effect of the catalogue with its group and the package that provides it."""

    kind: type[Effect]
    group: str
    origin: str


def installed() -> list[EntryPoint]:
    """Entry points that provide effects; a package that occurs twice on the path counts once."""
    points = {(_package(point), point.name, point.value): point for point in entry_points(group=GROUP)}
    return [points[key] for key in sorted(points)]


class Catalogue(Sequence[type[Effect]]):
    """Catalogue of all effects: `shipped` ones in their order, then added ones in the order of their names.

    `shipped` are the built-in effects by group; `points` returns the entry points of packages.
    """

    def __init__(
        self,
        shipped: Mapping[str, tuple[type[Effect], ...]],
        points: Callable[[], Iterable[EntryPoint]] = installed,
    ) -> None:
        self._points = points
        self._shipped = {kind.name: Listed(kind, group, SHIPPED) for group, kinds in shipped.items() for kind in kinds}

    @cached_property
    def entries(self) -> Mapping[str, Listed]:
        """All effects by name; raises ModelError, with package and reason, for an unusable effect of a package."""
        added: dict[str, Listed] = {}
        for point in self._points():
            entry = _loaded(point)
            earlier = (self._shipped | added).get(entry.kind.name)
            if earlier is not None:
                raise _refused(point, f"{earlier.origin} has an effect '{entry.kind.name}' already")
            added[entry.kind.name] = entry
        return self._shipped | {name: added[name] for name in sorted(added)}

    def add(self, kind: type[Effect]) -> type[Effect]:
        """Registration of an effect class for this session; it replaces an earlier one of the same name.

        A class without a card gets an empty one. Raises ModelError if the class is no valid effect.
        """
        if why := fault_of(kind):
            raise ModelError(f"{kind!r} cannot be an effect: {why}")
        earlier = self.entries.get(kind.name)
        if earlier is not None and earlier.group != SESSION:
            raise ModelError(f"{earlier.origin} has an effect '{kind.name}' already: take another name")
        try:
            card_of(kind)
        except ModelError:
            title = kind.name.replace("-", " ").capitalize()
            parts = "\n\n".join(f"{part}: not given." for part in PARTS)
            kind.__doc__ = f"{title}: an effect of this session.\n\nnot given\n\n{parts}\n"
        self.__dict__["entries"] = {**self.entries, kind.name: Listed(kind, SESSION, SESSION)}
        return kind

    @property
    def of_session(self) -> tuple[type[Effect], ...]:
        """Effect classes that were registered in this session; other processes do not have them."""
        return tuple(entry.kind for entry in self.entries.values() if entry.group == SESSION)

    def find(self, name: str) -> type[Effect]:
        """Class of the effect `name`; raises ModelError with the most similar names for an unknown one."""
        entry = self._shipped.get(name) or self.entries.get(name)
        if entry is None:
            raise unknown_name("effect", name, self.entries)
        return entry.kind

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[type[Effect]]:
        return (entry.kind for entry in self.entries.values())

    def __getitem__(self, index: Any) -> Any:
        return tuple(self)[index]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unknown package"


def _refused(point: EntryPoint, why: str) -> ModelError:
    place = f"{point.value} of {_package(point)}"
    return ModelError(f"the effect '{point.name}' ({place}) cannot be used: {why}; repair or uninstall that package")


def _loaded(point: EntryPoint) -> Listed:
    try:
        kind = point.load()
    except Exception as problem:  # whatever a stranger's module does when it is imported
        raise _refused(point, f"{type(problem).__name__}: {problem}") from problem
    if why := fault_of(kind):
        raise _refused(point, why)
    try:
        card_of(kind)
    except ModelError as problem:
        raise _refused(point, str(problem)) from None
    return Listed(kind, ADDED, _package(point))


def fault_of(kind: object) -> str:
    """Reason why a class is no valid effect; empty for a valid one."""
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        return "it is not a class derived from lt.Effect"
    if lacking := sorted(getattr(kind, "__abstractmethods__", ())):
        return f"its class lacks {', '.join(lacking)}"
    if not NAME.fullmatch(getattr(kind, "name", "")) or kind.name == "unknown":
        return f"its name '{getattr(kind, 'name', '')}' should be lower-case words joined by '-'"
    if not isinstance(getattr(kind, "stage", None), Stage) or not kind.parameters:
        return "its class lacks a stage or parameters"
    units = {p.name: p.unit for p in kind.parameters} | {s.name: s.unit for s in kind.shape}
    return next(
        (f"the unit '{u}' of {name} is not in {', '.join(FACTOR)}" for name, u in units.items() if u not in FACTOR), ""
    )
