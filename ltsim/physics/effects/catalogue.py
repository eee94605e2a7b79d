"""Catalogue of effects, built-in and from installed packages, with a catalogue entry for each effect.

A package provides effects by entry points of the group `ltsim.effects`. Each entry point has the name of an effect and
refers to its class:

    [project.entry-points."ltsim.effects"]
    cable-drag = "my_package.cable_drag:CableDrag"

Installed packages are searched when an effect that is not built-in is first needed, not when ltsim is imported.

The catalogue entry is the docstring of the effect's class, or of its module. Its first line is the title, a colon and
the cause. The equation follows, with its sign, and then a paragraph for each of `DOCSTRING_SECTIONS`.
"""

import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Self

from ltsim.core.errors import ModelError, unknown_name_error
from ltsim.core.units import SI_PER_UNIT, permitted_units_text
from ltsim.physics.effects.effect import Effect, LightPathStage

ENTRY_POINT_GROUP = "ltsim.effects"
"""Name of the group of entry points by which installed packages provide effects."""
BUILTIN_PROVIDER_NAME = "ltsim"
"""Name of the provider of the built-in effects, as the catalogue shows it."""
SESSION_PROVIDER_NAME = "this session"
"""Name of the provider, as the catalogue shows it, of effects that the user registered in the running Python
session."""
PACKAGE_EFFECTS_HEADING = "installed"
"""Heading in the catalogue of the group of effects from installed packages."""
NO_MEASUREMENT_PHRASE = "no measurement is needed"
"""Beginning of the section `Separate by` of an effect that needs no further measurement, because the readings
distinguish it from all other effects."""
EFFECT_NAME_PATTERN = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
"""Regular expression of permitted names of effects: lower-case words that are joined by hyphens."""
DOCSTRING_SECTIONS = ("Size", "Similar to", "Separate by", "Validity", "Source", "Validation")
"""Names of the sections of a catalogue entry after its equation, in their order. `Size`: sizes in a good and in a
bad instrument or hall. `Similar to`: effects with similar residuals, with the correlation of the residuals in the
reference workshop for one face and for two faces. `Separate by`: measurements that distinguish the effect from
similar effects. `Validity`: domain in which the equation holds. `Source`: literature. `Validation`: tests of the
equation."""
_SECTION_START_PATTERN = re.compile(rf"^({'|'.join(DOCSTRING_SECTIONS)}): ", re.MULTILINE)
"""Regular expression for the start of a section in a catalogue entry: the name of the section and a colon."""


@dataclass(frozen=True)
class CatalogueEntry:
    """Catalogue entry of an effect: its physical cause, its equation, and further sections of text."""

    title: str
    """Title of the effect: the name of its physical cause."""
    cause_description: str
    """Description of the physical cause."""
    equation: str
    """Equation of the effect with its sign, in the lines of the docstring."""
    section_texts: tuple[str, ...]
    """Texts of the sections of the catalogue entry, in the order of `DOCSTRING_SECTIONS`."""

    @classmethod
    def from_docstring(cls, docstring: str) -> Self:
        """Catalogue entry parsed from the docstring of an effect.

        Raises ModelError if a section is missing, repeated or out of order; the message names the sections.
        """
        head, _, rest = inspect.cleandoc(docstring).partition("\n\n")
        title, colon, cause = " ".join(head.split()).rstrip(".").partition(": ")
        if not colon or not cause:
            first_line = head.partition("\n")[0]
            raise ModelError(f"the docstring of an effect must begin with 'Title: cause.', found {first_line!r}")
        pieces = _SECTION_START_PATTERN.split(rest)
        if tuple(pieces[1::2]) != DOCSTRING_SECTIONS:
            wanted, present = ", ".join(DOCSTRING_SECTIONS), ", ".join(pieces[1::2]) or "none"
            raise ModelError(f"the docstring of an effect must have the sections {wanted} in order, found {present}")
        law, *sections = (piece.strip() for piece in pieces[::2])
        for name, part in zip(("law", *DOCSTRING_SECTIONS), (law, *sections), strict=True):
            if not part:
                raise ModelError(f"the section {name} of the docstring is empty")
        return cls(title, cause, law, tuple(" ".join(part.split()) for part in sections))

    @property
    def confirming_measurement(self) -> str:
        """Measurement that would confirm the effect; empty if none is needed.

        It is the first measurement in the section `Separate by`.
        """
        separating_text = dict(self.sections())["Separate by"]
        measurement = re.split("[;:]", separating_text, maxsplit=1)[0].rstrip(".")
        return "" if measurement.startswith(NO_MEASUREMENT_PHRASE) else measurement

    def sections(self) -> tuple[tuple[str, str], ...]:
        """Pairs of name and text of the sections of the catalogue entry after its equation."""
        return tuple(zip(DOCSTRING_SECTIONS, self.section_texts, strict=True))


@cache
def catalogue_entry(effect_class: type) -> CatalogueEntry:
    """Catalogue entry parsed from the docstring of an effect class, or of its module.

    Raises ModelError if neither docstring is complete.
    """
    doc = effect_class.__dict__.get("__doc__") or ""
    text = doc if _SECTION_START_PATTERN.search(inspect.cleandoc(doc)) else sys.modules[effect_class.__module__].__doc__
    try:
        return CatalogueEntry.from_docstring(text or "")
    except ModelError as problem:
        raise ModelError(f"{effect_class.__module__}.{effect_class.__name__}: {problem}") from None


@dataclass(frozen=True)
class ListedEffect:
    """Effect class with the group in which the catalogue lists it and with the provider of the effect."""

    effect_class: type[Effect]
    """Class of the effect."""
    group: str
    """Heading of the group in the catalogue."""
    provider: str
    """Name and version of the package that provides the effect; `BUILTIN_PROVIDER_NAME` for a built-in effect,
    `SESSION_PROVIDER_NAME` for an effect registered in this Python session."""


def installed_entry_points() -> list[EntryPoint]:
    """Entry points by which installed packages provide effects, each listed once even if its package is found twice."""
    points = {
        (_package_name_and_version(point), point.name, point.value): point
        for point in entry_points(group=ENTRY_POINT_GROUP)
    }
    return [points[key] for key in sorted(points)]


class Catalogue(Sequence[type[Effect]]):
    """Catalogue of all effects: built-in effects in their order, then other effects in alphabetical order.

    `built_in_effects` has the classes of the built-in effects by group. `find_entry_points` returns the entry points by
    which packages provide effects.
    """

    def __init__(
        self,
        built_in_effects: Mapping[str, tuple[type[Effect], ...]],
        find_entry_points: Callable[[], Iterable[EntryPoint]] = installed_entry_points,
    ) -> None:
        self._find_entry_points = find_entry_points
        self._builtin_effects = {
            kind.name: ListedEffect(kind, group, BUILTIN_PROVIDER_NAME)
            for group, kinds in built_in_effects.items()
            for kind in kinds
        }

    @cached_property
    def entries(self) -> Mapping[str, ListedEffect]:
        """Effects of the catalogue by name, each with its group and provider.

        Raises ModelError if an effect of an installed package cannot be used; the message names the package and the
        reason.
        """
        added: dict[str, ListedEffect] = {}
        for point in self._find_entry_points():
            entry = _load_listed_effect(point)
            earlier = (self._builtin_effects | added).get(entry.effect_class.name)
            if earlier is not None:
                raise _unusable_effect_error(
                    point, f"{earlier.provider} has an effect '{entry.effect_class.name}' already"
                )
            added[entry.effect_class.name] = entry
        return self._builtin_effects | {name: added[name] for name in sorted(added)}

    def add(self, effect_class: type[Effect]) -> type[Effect]:
        """Registration of an effect class for the running Python session; returns the class, as a decorator does.

        The class replaces an earlier class that was registered under the same name. A class without a complete
        docstring gets a catalogue entry without content. Raises ModelError if the class is no valid effect, or if a
        built-in effect or an effect of a package has its name.
        """
        if why := invalid_effect_reason(effect_class):
            raise ModelError(f"{effect_class!r} cannot be an effect: {why}")
        earlier = self.entries.get(effect_class.name)
        if earlier is not None and earlier.group != SESSION_PROVIDER_NAME:
            raise ModelError(f"{earlier.provider} already has an effect '{effect_class.name}'; use another name")
        try:
            catalogue_entry(effect_class)
        except ModelError:
            title = effect_class.name.replace("-", " ").capitalize()
            parts = "\n\n".join(f"{part}: not given." for part in DOCSTRING_SECTIONS)
            effect_class.__doc__ = f"{title}: an effect of this session.\n\nnot given\n\n{parts}\n"
        self.__dict__["entries"] = {
            **self.entries,
            effect_class.name: ListedEffect(effect_class, SESSION_PROVIDER_NAME, SESSION_PROVIDER_NAME),
        }
        return effect_class

    @property
    def runtime_effects(self) -> tuple[type[Effect], ...]:
        """Effect classes that were registered in the running Python session; other processes do not know them."""
        return tuple(entry.effect_class for entry in self.entries.values() if entry.group == SESSION_PROVIDER_NAME)

    def find(self, name: str) -> type[Effect]:
        """Class of the effect with the name `name`; raises ModelError with the most similar names if there is none."""
        entry = self._builtin_effects.get(name) or self.entries.get(name)
        if entry is None:
            raise unknown_name_error("effect", name, self.entries)
        return entry.effect_class

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[type[Effect]]:
        return (entry.effect_class for entry in self.entries.values())

    def __getitem__(self, index: Any) -> Any:
        return tuple(self)[index]


def _package_name_and_version(entry_point: EntryPoint) -> str:
    """Name and version of the installed package that declares an entry point."""
    return (
        f"{entry_point.dist.name} {entry_point.dist.version}" if entry_point.dist is not None else "an unknown package"
    )


def _unusable_effect_error(entry_point: EntryPoint, reason: str) -> ModelError:
    """Error with the `reason` why an effect cannot be used that a package provides by `entry_point`."""
    place = f"{entry_point.value} of {_package_name_and_version(entry_point)}"
    return ModelError(
        f"the effect '{entry_point.name}' ({place}) cannot be used: {reason}; repair or uninstall that package"
    )


def _load_listed_effect(entry_point: EntryPoint) -> ListedEffect:
    """Effect that an entry point of an installed package provides; raises ModelError if the effect cannot be used."""
    try:
        kind = entry_point.load()
    except Exception as problem:  # importing a module of another package may raise any error
        raise _unusable_effect_error(entry_point, f"{type(problem).__name__}: {problem}") from problem
    if why := invalid_effect_reason(kind):
        raise _unusable_effect_error(entry_point, why)
    try:
        catalogue_entry(kind)
    except ModelError as problem:
        raise _unusable_effect_error(entry_point, str(problem)) from None
    return ListedEffect(kind, PACKAGE_EFFECTS_HEADING, _package_name_and_version(entry_point))


def invalid_effect_reason(effect_class: object) -> str:
    """Reason why a class cannot be used as an effect, as text for users; empty if it can be used."""
    if not (isinstance(effect_class, type) and issubclass(effect_class, Effect)):
        return "it is not a class derived from lt.Effect"
    if missing_methods := sorted(getattr(effect_class, "__abstractmethods__", ())):
        return f"its class lacks {', '.join(missing_methods)}"
    if not EFFECT_NAME_PATTERN.fullmatch(getattr(effect_class, "name", "")) or effect_class.name == "unknown":
        return f"its name '{getattr(effect_class, 'name', '')}' must be lower-case words joined by '-'"
    if not isinstance(getattr(effect_class, "light_path_stage", None), LightPathStage) or not effect_class.parameters:
        return "its class lacks a light_path_stage or parameters"
    if not (isinstance(effect_class.base_rate, int | float) and 0.0 < effect_class.base_rate < math.inf):
        return f"its base_rate is {effect_class.base_rate!r}, expected a positive number"
    units = {p.name: p.unit for p in effect_class.parameters} | {s.name: s.unit for s in effect_class.shape_parameters}
    return next(
        (
            f"the unit '{u}' of {name} is not one of {permitted_units_text()}"
            for name, u in units.items()
            if u not in SI_PER_UNIT
        ),
        "",
    )
