"""The catalogue of effects: what ships with ltsim, then what installed packages add.

A package adds effects by entry points of the group `ltsim.effects`, each naming a class:

    [project.entry-points."ltsim.effects"]
    cable-drag = "my_package.cable_drag:CableDrag"

They are looked for when the catalogue is first read beyond what ships, not when ltsim is imported.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import overload

from ltsim.effects.card import PARTS, card_of
from ltsim.effects.effect import Effect, Stage
from ltsim.errors import ModelError, unknown_name
from ltsim.units import FACTOR

GROUP = "ltsim.effects"
SHIPPED = "ltsim"
SESSION = "this session"
ADDED = "installed"
"""The group of effects that packages add."""
NAME = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")


@dataclass(frozen=True)
class Entry:
    """An effect of the catalogue, the group it stands in, and the package it comes from."""

    kind: type[Effect]
    group: str
    origin: str


def effects_in(*modules: ModuleType) -> tuple[type[Effect], ...]:
    """The effects that files define, in their order: classes with a name."""
    classes = [(module, thing) for module in modules for thing in vars(module).values() if isinstance(thing, type)]
    own = [kind for module, kind in classes if issubclass(kind, Effect) and kind.__module__ == module.__name__]
    return tuple(kind for kind in own if isinstance(kind.name, str))


def installed() -> list[EntryPoint]:
    """Entry points that name effects; a package that is found twice on the path counts once."""
    found = {(_package(point), point.name, point.value): point for point in entry_points(group=GROUP)}
    return [found[key] for key in sorted(found)]


class Catalogue(Sequence[type[Effect]]):
    """Every effect: those of `shipped` in their order, then the added ones in the order of their names.

    Parameters
    ----------
    shipped : mapping of str to tuple of type
        Effects by group.
    points : callable
        Gives the entry points of packages.
    """

    def __init__(
        self,
        shipped: Mapping[str, tuple[type[Effect], ...]],
        points: Callable[[], Iterable[EntryPoint]] = installed,
    ) -> None:
        self._points = points
        self._shipped = {kind.name: Entry(kind, group, SHIPPED) for group, kinds in shipped.items() for kind in kinds}

    @cached_property
    def entries(self) -> Mapping[str, Entry]:
        """All effects by name; raises ModelError when a package's effect cannot be used: which package, and why."""
        added: dict[str, Entry] = {}
        for point in self._points():
            entry = _loaded(point)
            known = (self._shipped | added).get(entry.kind.name)
            if known is not None:
                raise _refused(point, f"{known.origin} has an effect '{entry.kind.name}' already")
            added[entry.kind.name] = entry
        return self._shipped | {name: added[name] for name in sorted(added)}

    def add(self, kind: type[Effect]) -> type[Effect]:
        """Add a class for the rest of this session, in place of one of the same name that was added before.

        A class without a card is given one that states nothing. Raises ModelError when it cannot be an effect.
        """
        if why := fault_of(kind):
            raise ModelError(f"{kind!r} cannot be an effect: {why}")
        known = self.entries.get(kind.name)
        if known is not None and known.group != SESSION:
            raise ModelError(f"{known.origin} has an effect '{kind.name}' already: take another name")
        try:
            card_of(kind)
        except ModelError:
            title, parts = (
                kind.name.replace("-", " ").capitalize(),
                "\n\n".join(f"{part}: not stated." for part in PARTS),
            )
            kind.__doc__ = f"{title}: an effect of this session.\n\nnot stated\n\n{parts}\n"
        self.__dict__.pop("_kinds", None)
        self.__dict__["entries"] = {**self.entries, kind.name: Entry(kind, SESSION, "this session")}
        return kind

    @property
    def of_session(self) -> tuple[type[Effect], ...]:
        """Classes that were added in this session: other processes do not know them."""
        return tuple(entry.kind for entry in self.entries.values() if entry.group == SESSION)

    def find(self, name: str) -> type[Effect]:
        """The effect called `name`.

        Raises
        ------
        ModelError
            When there is none; the message names the closest ones.
        """
        entry = self._shipped.get(name) or self.entries.get(name)
        if entry is None:
            raise unknown_name("effect", name, self.entries)
        return entry.kind

    @cached_property
    def _kinds(self) -> tuple[type[Effect], ...]:
        return tuple(entry.kind for entry in self.entries.values())

    def __len__(self) -> int:
        return len(self._kinds)

    def __iter__(self) -> Iterator[type[Effect]]:
        return iter(self._kinds)

    @overload
    def __getitem__(self, index: int) -> type[Effect]: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[type[Effect], ...]: ...
    def __getitem__(self, index: int | slice) -> type[Effect] | tuple[type[Effect], ...]:
        return self._kinds[index]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unknown package"


def _refused(point: EntryPoint, why: str) -> ModelError:
    place = f"{point.value} of {_package(point)}"
    return ModelError(f"the effect '{point.name}' ({place}) cannot be used: {why}; mend or uninstall that package")


def _loaded(point: EntryPoint) -> Entry:
    try:
        kind = point.load()
    except Exception as problem:  # whatever a stranger's module does when it is imported
        raise _refused(point, f"{type(problem).__name__}: {problem}") from problem
    why = fault_of(kind)
    if not why:
        try:
            card_of(kind)
        except ModelError as problem:
            why = str(problem)
    if why:
        raise _refused(point, why)
    return Entry(kind, ADDED, _package(point))


def fault_of(kind: object) -> str:
    """Why a class cannot be an effect; empty for none."""
    if not (isinstance(kind, type) and issubclass(kind, Effect)):
        return "it is no class derived from ltsim.effects.Effect"
    if lacking := sorted(getattr(kind, "__abstractmethods__", ())):
        return f"its class lacks {', '.join(lacking)}"
    if not NAME.fullmatch(getattr(kind, "name", "")) or kind.name == "unknown":
        return f"its name '{getattr(kind, 'name', '')}' should be lower-case words joined by '-'"
    if not isinstance(getattr(kind, "stage", None), Stage) or not kind.parameters:
        return "its class lacks a stage or parameters"
    units = {p.name: p.unit for p in kind.parameters} | {s.name: s.unit for s in kind.shape}
    return next(
        (f"the unit '{u}' of {name} is none of {', '.join(FACTOR)}" for name, u in units.items() if u not in FACTOR), ""
    )
