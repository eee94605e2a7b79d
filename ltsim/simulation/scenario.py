"""A scenario: everything a simulation needs but the seed, as a file a person can read and edit."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ltsim.core.arrays import Floats
from ltsim.core.errors import SetupError, as_setup_error
from ltsim.core.results import Result
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import Sized, effect_from
from ltsim.recordings.air import Air
from ltsim.recordings.files import SourceLocation, shown
from ltsim.recordings.settings import checked, merge_defaults, read_toml, to_toml, with_instruments
from ltsim.recordings.setup import Material, NonNegative, Reflector, TomlSection
from ltsim.recordings.specification import sheet_names, tables_from_sheet
from ltsim.simulation.builtin import builtin_names, builtin_path
from ltsim.simulation.sections import (
    PRESETS,
    Cmm,
    EffectEntry,
    Length,
    Placing,
    PlannedStation,
    PlannedTarget,
    PointingLimits,
    ScenarioGauge,
    ScenarioInstrument,
    Smr,
    Work,
    Workshop,
)

FORMAT = "ltsim-scenario/1"
AIR = "air_temperature_c"
"""The one column of temperatures that a simulated recording has."""
LEAST = 3
"""Targets, those of the gauge among them."""
MOST_LISTED = 12
SPELLED_OUT = (
    "format", "title", "reference_radius_mm", "workshop", "placing", "instrument", "smr", "cmm", "work", "instruments",
    "gauge",
)  # fmt: skip
"""Keys that a scenario's file holds with all their defaults."""
NONE = "none"
"""Value that removes a key of the scenario: ``gauge = "none"``."""


class Scenario(TomlSection, Result):
    """The whole file."""

    format: Literal["ltsim-scenario/1"] = "ltsim-scenario/1"
    """Format and version of this file."""
    title: str = ""
    """Free text."""
    base: str | None = None
    """A built-in scenario whose tables hold below those of this file; "none" in place of a table takes it out."""
    workshop: Workshop = Workshop()
    """Room, air and obstacles."""
    placing: Placing = Placing()
    """Standard deviations of the true places about the plan."""
    instrument: ScenarioInstrument = ScenarioInstrument()
    """The tracker of every station that names no other."""
    instruments: dict[str, ScenarioInstrument] = Field(default_factory=dict)
    """Several trackers by name, tables `[instruments.NAME]`, all of one construction."""
    smr: Smr = Smr()
    """The reflectors."""
    reflectors: dict[str, Reflector] = Field(default_factory=dict)
    """SMRs with a separate radius, tables `[reflectors.NAME]`, one a target or a station; the centre stands off along
    the nest's normal, and true radii are drawn with the places."""
    reference_radius_mm: NonNegative | None = None
    """Planned places are centres of an SMR of this radius, 0 for the seats; as in `setup.toml`, which takes it over."""
    cmm: Cmm = Cmm()
    """The coordinate measuring machine that calibrated the gauge."""
    work: Work = Work()
    """Order and clock of the measurements."""
    gauge: ScenarioGauge | None = None
    """A frame of known lengths."""
    materials: dict[str, Material] = Field(default_factory=dict)
    """Materials of known lengths, tables `[materials.NAME]`; the true coefficient is drawn."""
    lengths: tuple[Length, ...] = ()
    """Known lengths between reflectors of the mesh, tables `[[lengths]]`."""
    stations: dict[str, PlannedStation]
    """Set-ups, tables `[stations.NAME]`, in the order of the work."""
    targets: dict[str, PlannedTarget] = Field(default_factory=dict)
    """Reflectors, tables `[targets.NAME]`."""
    air: Air | None = None
    """Uncertainty of the air that the recording declares, a table `[air]`; it changes no reading."""
    effects: tuple[EffectEntry, ...] = ()
    """Physics beyond the instrument's errors, tables `[[effects]]`."""

    @property
    def target_names(self) -> tuple[str, ...]:
        """Targets of the mesh, then those of the gauge."""
        return (*self.targets, *(self.gauge.targets if self.gauge else ()))

    @property
    def trackers(self) -> dict[str, ScenarioInstrument]:
        """The instruments in use by name, in the order of `Recording.instruments`; one without a name is ''."""
        names = sorted({station.instrument or "" for station in self.stations.values()})
        return {name: self.instruments[name] if name else self.instrument for name in names}

    def stations_of(self, tracker: str) -> tuple[str, ...]:
        """The stations where the tracker of this name stands."""
        return tuple(name for name, station in self.stations.items() if (station.instrument or "") == tracker)

    def _lines(self) -> list[str]:
        title = f"{self.title}: " if self.title else ""
        faces = "two faces" if self.work.faces == 2 else "one face"
        effects = ", ".join(entry.name for entry in self.effects) or "no effects"
        trackers = f" by {len(self.trackers)} trackers" if len(self.trackers) > 1 else ""
        measured = f"{len(self.stations)} stations{trackers}, {len(self.target_names)} targets"
        return [f"Scenario: {title}{measured}, {faces}, {effects}"]

    __repr__ = __str__ = Result.__repr__


def load_scenario(name_or_path: str | Path) -> Scenario:
    """A built-in scenario by its name, or that of a file or of a plan's folder; raises SetupError."""
    path, name = Path(name_or_path), str(name_or_path)
    if (path / "plan.json").is_file():
        path = path / "scenario.toml"
    if name in builtin_names() or not path.exists():
        path = builtin_path(name)
    with as_setup_error():
        data = read_toml(path, "scenario")
    return scenario_from(data, path)


def scenario_from(data: Mapping[str, Any], file: Path) -> Scenario:
    """Check the tables of a scenario; `file` is named in errors, its folder holds CAD files."""
    with as_setup_error():
        whole = with_instruments(_with_base(data), lambda table, _: _with_preset(table, file))
        scenario = checked(whole, Scenario, "scenario", file)
    _check(scenario, file)
    return _resolve_paths(_in_use(scenario, file), file)


def changed(scenario: Scenario, changes: Mapping[str, Any], file: Path, where: str = "") -> Scenario:
    """A scenario with some values changed, by dotted key, and checked again; `file` and `where` are named in errors.

    A tracker's `preset` brings its noise and prior with it, and its limits or the question for them. Raises SetupError
    when a key or value is one that no scenario can have.
    """
    # Checked twice: as tables with the changes, and as what a file of it would say.
    table = scenario.model_dump(mode="json", by_alias=True, exclude_none=True)
    of_presets = sorted({section for sections in PRESETS.values() for section in sections})
    brought = [f"{key.removesuffix('preset')}{s}" for key in changes if key.endswith(".preset") for s in of_presets]
    of_sheets = [key for key, value in changes.items() if key.endswith(".preset") and value in sheet_names()]
    brought += [key.removesuffix("preset") + "limits" for key in of_sheets]
    for key, value in [*((key, NONE) for key in brought), *changes.items()]:
        _set(table, key, _as_table(value, effects=key == "effects"), where or str(file))
    return scenario_from(table, file)


def _as_table(value: Any, *, effects: bool) -> Any:
    """A new value as a file has it: effects (`lt.Effect`, or their names), alone or in a list, as their tables."""
    if isinstance(value, Effect | Sized) or (effects and isinstance(value, str)):
        value = [value]
    if not isinstance(value, (list, tuple)):
        return value
    given = [effect_from(v, {}, {}) if effects and isinstance(v, str) else v for v in value]
    return [
        EffectEntry.of(v).model_dump(mode="json", exclude_defaults=True) if isinstance(v, Effect | Sized) else v
        for v in given
    ]


def _set(table: dict[str, Any], key: str, value: Any, where: str) -> None:
    """Set one dotted key of nested tables, entries of lists by number from 1; the value `NONE` removes it."""
    *parents, last = key.split(".")
    inner: Any = table
    for name in parents:
        if isinstance(inner, list) and name.isdecimal() and 1 <= int(name) <= len(inner):
            inner = inner[int(name) - 1]
        else:
            inner = inner.setdefault(name, {}) if isinstance(inner, dict) else None
        if not isinstance(inner, (dict, list)):
            raise SetupError(f"{where}: {shown(key)} goes through {shown(name)}, which is no table of the scenario")
    if not isinstance(inner, dict):
        raise SetupError(f"{where}: {shown(key)} is no key of a table; entries of a list are numbered from 1")
    if value == NONE:
        inner.pop(last, None)
    else:
        inner[last] = value


def _with_base(data: Mapping[str, Any]) -> Mapping[str, Any]:
    """The tables above those of the scenario that they name as their base."""
    if data.get("base") is None:
        return data
    below = _with_base(read_toml(builtin_path(str(data["base"])), "scenario"))
    return {key: value for key, value in merge_defaults(data, below).items() if key != "base" and value != NONE}


def _with_preset(instrument: Any, file: Path) -> Any:
    """An instrument with its preset below what the file says of it."""
    if not isinstance(instrument, dict):
        return instrument
    name = instrument.get("preset")
    if name not in sheet_names():
        return merge_defaults(instrument, PRESETS.get(str(name), {}))
    with as_setup_error(f"{file}: instrument.preset"):
        below = tables_from_sheet(name, instrument, PointingLimits.model_fields)
    return merge_defaults(instrument, below)


def _in_use(scenario: Scenario, file: Path) -> Scenario:
    """The scenario without the stations and reflectors that ``work.stations`` and ``work.targets`` leave out.

    Effects lose the places that are left out, trackers that then stand nowhere go too. Raises SetupError when more is
    asked for than there is, or fewer than three targets are left.
    """
    work = scenario.work
    for key in ("stations", "targets"):
        wanted, there = getattr(work, key), len(getattr(scenario, key))
        if wanted is not None and wanted > there:
            raise SetupError(
                f"{file}: work.{key} is {wanted}, but the scenario holds {there}: add some, or ask for fewer"
            )
    stations = dict(list(scenario.stations.items())[: work.stations])
    targets = scenario.targets if work.targets is None else _spread(scenario.targets, work.targets)
    gauge = scenario.gauge.targets if scenario.gauge else ()
    if len(targets) + len(gauge) < LEAST:
        least = LEAST - len(gauge)
        raise SetupError(f"{file}: work.targets is {work.targets}, expected at least {least} of the reflectors")
    if len(stations) == len(scenario.stations) and len(targets) == len(scenario.targets):
        return scenario
    used = {station.instrument for station in stations.values()}
    return scenario.model_copy(
        update={
            "stations": stations,
            "targets": targets,
            "instruments": {name: i for name, i in scenario.instruments.items() if name in used},
            "lengths": tuple(bar for bar in scenario.lengths if {bar.from_, bar.to} <= {*targets}),
            "effects": tuple(_effects(scenario.effects, {*stations}, {*targets, *gauge})),
        }
    )


def _effects(entries: Sequence[EffectEntry], stations: set[str], targets: set[str]) -> Iterator[EffectEntry]:
    for entry in entries:
        here = {
            "stations": tuple(name for name in entry.stations if name in stations),
            "targets": tuple(name for name in entry.targets if name in targets),
        }
        if all(bool(value) == bool(getattr(entry, kind)) for kind, value in here.items()):
            yield entry.model_copy(update=here)


def _spread(targets: Mapping[str, PlannedTarget], count: int) -> dict[str, PlannedTarget]:
    """Subset of `count` targets in the file's order, each farthest from those before it (Gonzalez 1985)."""
    places = np.array([t.position_mm for t in targets.values()], dtype=np.float64).reshape(-1, 3)
    taken = set(spread_order(places)[:count])
    return {name: target for i, (name, target) in enumerate(targets.items()) if i in taken}


def spread_order(places: Floats) -> list[int]:
    """Places (n, 3) in the order in which they fill the room, the one farthest from their middle first."""
    order: list[int] = []
    gap = np.linalg.norm(places - places.mean(axis=0), axis=1) if len(places) else np.zeros(0)
    for _ in range(len(places)):
        order.append(int(np.argmax(gap)))
        reach = np.linalg.norm(places - places[order[-1]], axis=1)
        gap = reach if len(order) == 1 else np.minimum(gap, reach)
        gap[order] = -1.0
    return order


def _resolve_paths(scenario: Scenario, file: Path) -> Scenario:
    """CAD files are named from the folder of the scenario, or lie in it."""
    obstacles = tuple(
        o if o.file is None else o.model_copy(update={"file": str(_local_path(o.file, file.parent))})
        for o in scenario.workshop.obstacles
    )
    if not any(o.file for o in obstacles):
        return scenario
    return scenario.model_copy(update={"workshop": scenario.workshop.model_copy(update={"obstacles": obstacles})})


def _local_path(name: str, folder: Path) -> Path:
    named, copied = folder / name, folder / Path(name).name
    return copied if copied.is_file() and not named.is_file() else named


def _check(scenario: Scenario, file: Path) -> None:
    for problem in chain(
        _wrong_names(scenario, file),
        _wrong_instruments(scenario),
        _wrong_places(scenario),
        _wrong_lengths(scenario),
        _wrong_effects(scenario),
    ):
        raise SetupError(f"{file}: {problem}")


def _unlisted(key: str, name: str, existing: Collection[str], none: str = "") -> Iterator[str]:
    """A sentence where a name is not among those that are known; `none` stands for an empty list."""
    if name not in existing:
        listed = ", ".join([*existing][:MOST_LISTED]) + (" ..." if len(existing) > MOST_LISTED else "")
        yield f"{key} names '{shown(name)}', which is not one of {listed or none}"


def _wrong_names(scenario: Scenario, file: Path) -> Iterator[str]:
    names = scenario.target_names
    if not scenario.stations:
        yield "stations is empty, expected at least one table [stations.NAME]"
    if len(names) < LEAST:
        yield f"targets holds {len(names)} reflectors with the gauge's, expected at least {LEAST}"
    for name in names:
        if names.count(name) > 1:
            yield f"gauge.targets names '{shown(name)}' twice, or it is a target of the mesh too"
    for kind, listed in (("station", scenario.stations), ("target", names), ("instrument", scenario.instruments)):
        for name in listed:
            with as_setup_error():
                SourceLocation(file).name(name, kind)


def _wrong_instruments(scenario: Scenario) -> Iterator[str]:
    """Stations of known trackers, trackers that stand somewhere, and one construction for all."""
    used = {name: station.instrument for name, station in scenario.stations.items() if station.instrument is not None}
    for station, name in used.items():
        if not scenario.instruments:
            yield f"stations.{station}.instrument names '{shown(name)}', which is not declared"
        yield from _unlisted(f"stations.{station}.instrument", name, scenario.instruments)
    for name in scenario.instruments:
        if name not in used.values():
            yield f"instruments.{shown(name)} stands nowhere; name it as the instrument of a station"
    if "" not in scenario.trackers and scenario.instrument != ScenarioInstrument():
        yield "instrument is stated but stands nowhere: every station names an instrument of its own"
    designs = {name: (i.construction, i.harmonics, i.degree) for name, i in scenario.trackers.items()}
    (first, first_design), *others = designs.items()
    for name, other in others:
        if other != first_design:
            designs_named = " and ".join(f"{table_name(n)} '{designs[n][0]}'" for n in (first, name))
            yield f"instruments hold different constructions ({designs_named}); one recording has one, with one order"


def _wrong_places(scenario: Scenario) -> Iterator[str]:
    size = scenario.workshop.size_mm
    placed = {f"stations.{name}": station.position_mm for name, station in scenario.stations.items()}
    placed |= {f"targets.{name}": target.position_mm for name, target in scenario.targets.items()}
    placed |= {"gauge": scenario.gauge.position_mm} if scenario.gauge else {}
    for key, place in placed.items():
        if any(not -1.0 <= x <= high + 1.0 for x, high in zip(place, size, strict=True)):
            room = " x ".join(f"{x:g}" for x in size)
            where = f"outside the workshop of {room} mm whose corner is the origin"
            yield f"{key}.position_mm is {list(place)}, {where}"
    for name, target in scenario.targets.items():
        if target.nest_normal is not None and not any(target.nest_normal):
            yield f"targets.{name}.nest_normal is a vector without length"


def _wrong_lengths(scenario: Scenario) -> Iterator[str]:
    """Lengths between two reflectors, of stated materials, as warm as a number or the air."""
    for i, length in enumerate(scenario.lengths, 1):
        for key, name in (("from", length.from_), ("to", length.to)):
            yield from _unlisted(f"lengths.{i}.{key}", name, scenario.targets)
        if length.from_ == length.to:
            yield f"lengths.{i} goes from '{shown(length.to)}' to itself, expected two different targets"
        if length.material is not None:
            none_hint = "none, and a table [materials.NAME] states one"
            yield from _unlisted(f"lengths.{i}.material", length.material, scenario.materials, none_hint)
        if isinstance(length.measured_at_c, str) and length.measured_at_c != AIR:
            yield f"lengths.{i}.measured_at_c is '{shown(length.measured_at_c)}', expected a number or '{AIR}'"


def _wrong_effects(scenario: Scenario) -> Iterator[str]:
    for i, entry in enumerate(scenario.effects, 1):
        for name in entry.stations:
            yield from _unlisted(f"effects.{i}.stations", name, scenario.stations)
        for name in entry.targets:
            yield from _unlisted(f"effects.{i}.targets", name, scenario.target_names)


def table_name(name: str) -> str:
    """The table of a scenario that holds the tracker of this name; '' for the one without."""
    return f"instruments.{name}" if name else "instrument"


def scenario_to_toml(scenario: Scenario) -> str:
    """The text of a file that `load_scenario` turns into the same scenario, every setting spelled out."""
    whole = scenario.model_dump(by_alias=True, exclude_none=True)
    brief = scenario.model_dump(by_alias=True, exclude_defaults=True)
    table: dict[str, Any] = {name: whole[name] for name in SPELLED_OUT if name in whole}
    table |= {kind: brief.get(kind, {}) for kind in ("reflectors", "materials", "stations", "targets")}
    return to_toml(table | {kind: brief[kind] for kind in ("air", "lengths", "effects") if kind in brief})
