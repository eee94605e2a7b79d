"""A scenario: everything a simulation needs but the seed, as a file a person can read and edit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, NoReturn

from pydantic import Field

from ltsim.errors import ModelError, SetupError, as_setup_error
from ltsim.recording.files import check_name, shown
from ltsim.recording.settings import above, checked, read_toml, to_toml
from ltsim.recording.setup import Material, NonNegative, Reflector, Section, Vector
from ltsim.recording.specification import sheet_names, stated_by
from ltsim.results import Result
from ltsim.simulation.builtin import builtin_names, builtin_path
from ltsim.simulation.sections import (
    PRESETS,
    Cmm,
    EffectEntry,
    Gauge,
    Instrument,
    Length,
    Limits,
    Placing,
    Smr,
    Station,
    Target,
    Work,
    Workshop,
)
from ltsim.simulation.subset import in_use

FORMAT = "ltsim-scenario/1"
AIR = "air_temperature_c"
"""The one column of temperatures that a simulated recording has."""
NONE = "none"
"""As a changed value it takes a key of the scenario out: ``gauge = "none"``."""


class Scenario(Section, Result):
    """The whole file."""

    format: Literal["ltsim-scenario/1"] = "ltsim-scenario/1"
    """Which format and version this file is in."""
    title: str = ""
    """Free text."""
    workshop: Workshop = Workshop()
    """The room, its air, what stands in it."""
    placing: Placing = Placing()
    """How far the truth is from the plan."""
    instrument: Instrument = Instrument()
    """The tracker of every station that names no other."""
    instruments: dict[str, Instrument] = Field(default_factory=dict)
    """Several trackers by name, tables `[instruments.NAME]`, all of one construction."""
    smr: Smr = Smr()
    """The reflectors."""
    reflectors: dict[str, Reflector] = Field(default_factory=dict)
    """Balls with radii of their own, tables `[reflectors.NAME]`, one a target or a station; the centre stands off along
    the nest's normal, and true radii are drawn with the places."""
    reference_radius_mm: NonNegative | None = None
    """Planned places are centres of a ball of this radius, 0 for the seats; as in `setup.toml`, which takes it over."""
    cmm: Cmm = Cmm()
    """The coordinate measuring machine that calibrated the gauge."""
    work: Work = Work()
    """Order and clock of the measurements."""
    gauge: Gauge | None = None
    """A frame of known lengths."""
    materials: dict[str, Material] = Field(default_factory=dict)
    """Materials of known lengths, tables `[materials.NAME]`; the true coefficient is drawn."""
    lengths: tuple[Length, ...] = ()
    """Known lengths between reflectors of the mesh, tables `[[lengths]]`."""
    stations: dict[str, Station]
    """Set-ups, tables `[stations.NAME]`, in the order of the work."""
    targets: dict[str, Target] = Field(default_factory=dict)
    """Reflectors, tables `[targets.NAME]`."""
    effects: tuple[EffectEntry, ...] = ()
    """Physics beyond the instrument's errors, tables `[[effects]]`."""

    @property
    def target_names(self) -> tuple[str, ...]:
        """Targets of the mesh, then those of the gauge."""
        return (*self.targets, *(self.gauge.targets if self.gauge else ()))

    @property
    def trackers(self) -> dict[str, Instrument]:
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

    __repr__ = Result.__repr__


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
        scenario = checked(_with_presets(data, file), Scenario, "scenario", file)
    _check(scenario, file)
    return _with_files_beside(in_use(scenario, file), file)


def changed(scenario: Scenario, changes: Mapping[str, Any], file: Path, where: str = "") -> Scenario:
    """A scenario with some values changed, by dotted key, and checked again; `file` and `where` are named in errors.

    A tracker's `preset` brings its noise and prior with it, and its limits or the question for them.

    Raises
    ------
    SetupError
        When a key or value is one that no scenario can have.
    """
    # Checked twice: as tables with the changes, and as what a file of it would say.
    table = scenario.model_dump(mode="json", by_alias=True, exclude_none=True)
    of_presets = sorted({section for sections in PRESETS.values() for section in sections})
    brought = [f"{key.removesuffix('preset')}{s}" for key in changes if key.endswith(".preset") for s in of_presets]
    of_sheets = [key for key, value in changes.items() if key.endswith(".preset") and value in sheet_names()]
    brought += [key.removesuffix("preset") + "limits" for key in of_sheets]
    for key, value in [*((key, NONE) for key in brought), *changes.items()]:
        _set(table, key, value, where or str(file))
    return scenario_from(table, file)


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


def _with_presets(data: Mapping[str, Any], file: Path) -> Mapping[str, Any]:
    """The tables with the preset of each instrument filled in below what the file says."""
    filled = {**data, "instrument": _with_preset(data.get("instrument", {}), file)}
    named = data.get("instruments")
    if isinstance(named, dict):
        filled["instruments"] = {name: _with_preset(table, file) for name, table in named.items()}
    return filled


def _with_preset(instrument: Any, file: Path) -> Any:
    if not isinstance(instrument, dict):
        return instrument
    name = instrument.get("preset")
    if name not in sheet_names():
        return above(instrument, PRESETS.get(str(name), {}))
    try:
        return above(instrument, stated_by(name, instrument, Limits.model_fields))
    except ModelError as problem:
        raise SetupError(f"{file}: instrument.preset: {problem}") from None


def _with_files_beside(scenario: Scenario, file: Path) -> Scenario:
    """CAD files are named from the folder of the scenario, or lie in it."""
    obstacles = tuple(
        o if o.file is None else o.model_copy(update={"file": str(_beside(o.file, file.parent))})
        for o in scenario.workshop.obstacles
    )
    if not any(o.file for o in obstacles):
        return scenario
    return scenario.model_copy(update={"workshop": scenario.workshop.model_copy(update={"obstacles": obstacles})})


def _beside(name: str, folder: Path) -> Path:
    named, copied = folder / name, folder / Path(name).name
    return copied if copied.is_file() and not named.is_file() else named


Refuse = Callable[[str, str], NoReturn]


def _check(scenario: Scenario, file: Path) -> None:
    """What no single key can tell: names, places inside the room, effects that name what exists."""

    def refuse(key: str, message: str) -> NoReturn:
        raise SetupError(f"{file}: {key} {message}")

    _check_names(scenario, file, refuse)
    _check_instruments(scenario, refuse)
    _check_places(scenario, refuse)
    _check_lengths(scenario, refuse)
    for i, entry in enumerate(scenario.effects):
        for kind, wanted, known in (
            ("stations", entry.stations, tuple(scenario.stations)),
            ("targets", entry.targets, scenario.target_names),
        ):
            for name in wanted:
                if name not in known:
                    refuse(f"effects.{i + 1}.{kind}", f"names '{shown(name)}', which is not one of {_listed(known)}")


def _check_names(scenario: Scenario, file: Path, refuse: Refuse) -> None:
    names = scenario.target_names
    if not scenario.stations:
        refuse("stations", "is empty, expected at least one table [stations.NAME]")
    if len(names) < 3:
        refuse("targets", f"holds {len(names)} reflectors with the gauge's, expected at least 3")
    for name in names:
        if names.count(name) > 1:
            refuse("gauge.targets", f"names '{shown(name)}' twice, or it is a target of the mesh too")
    for kind, listed in (("station", scenario.stations), ("target", names), ("instrument", scenario.instruments)):
        for name in listed:
            with as_setup_error():
                check_name(name, kind, file=file)


def _check_instruments(scenario: Scenario, refuse: Refuse) -> None:
    """Stations of known trackers, trackers that stand somewhere, and one construction for all."""
    used = {name: station.instrument for name, station in scenario.stations.items() if station.instrument is not None}
    for station, name in used.items():
        if name not in scenario.instruments:
            known = f"one of {_listed(scenario.instruments)}" if scenario.instruments else "declared"
            refuse(f"stations.{station}.instrument", f"names '{shown(name)}', which is not {known}")
    for name in scenario.instruments:
        if name not in used.values():
            refuse(f"instruments.{shown(name)}", "stands nowhere; name it as the instrument of a station")
    if "" not in scenario.trackers and scenario.instrument != Instrument():
        refuse("instrument", "is stated but stands nowhere: every station names an instrument of its own")
    designs = {name: (i.construction, i.harmonics, i.degree) for name, i in scenario.trackers.items()}
    (first, one), *others = designs.items()
    for name, other in others:
        if other != one:
            found = " and ".join(f"{table_name(n)} '{designs[n][0]}'" for n in (first, name))
            refuse("instruments", f"hold different constructions ({found}); one recording has one, with one order")


def _check_lengths(scenario: Scenario, refuse: Refuse) -> None:
    """Lengths between two reflectors, of stated materials, as warm as a number or the air."""
    for i, length in enumerate(scenario.lengths):
        for key, name in (("from", length.from_), ("to", length.to)):
            if name not in scenario.targets:
                refuse(
                    f"lengths.{i + 1}.{key}", f"names '{shown(name)}', which is not one of {_listed(scenario.targets)}"
                )
        if length.from_ == length.to:
            refuse(f"lengths.{i + 1}", f"goes from '{shown(length.to)}' to itself, expected two different targets")
        if length.material is not None and length.material not in scenario.materials:
            known = _listed(scenario.materials) or "none, and a table [materials.NAME] states one"
            refuse(f"lengths.{i + 1}.material", f"names '{shown(length.material)}', which is not one of {known}")
        if isinstance(length.measured_at_c, str) and length.measured_at_c != AIR:
            refuse(
                f"lengths.{i + 1}.measured_at_c", f"is '{shown(length.measured_at_c)}', expected a number or '{AIR}'"
            )


def table_name(name: str) -> str:
    """The table of a scenario that holds the tracker of this name; '' for the one without."""
    return f"instruments.{name}" if name else "instrument"


def _check_places(scenario: Scenario, refuse: Refuse) -> None:
    size = scenario.workshop.size_mm

    def check(key: str, place: Vector) -> None:
        if any(not -1.0 <= x <= high + 1.0 for x, high in zip(place, size, strict=True)):
            room = " x ".join(f"{x:g}" for x in size)
            refuse(key, f"is {list(place)}, outside the workshop of {room} mm whose corner is the origin")

    for name, station in scenario.stations.items():
        check(f"stations.{name}.position_mm", station.position_mm)
    for name, target in scenario.targets.items():
        check(f"targets.{name}.position_mm", target.position_mm)
        if target.nest_normal is not None and not any(target.nest_normal):
            refuse(f"targets.{name}.nest_normal", "is a vector without length")
    if scenario.gauge is not None:
        check("gauge.position_mm", scenario.gauge.position_mm)


def _listed(names: Iterable[str], most: int = 12) -> str:
    known = list(names)
    return ", ".join(known[:most]) + (" ..." if len(known) > most else "")


def scenario_to_toml(scenario: Scenario) -> str:
    """The text of a file that `load_scenario` turns into the same scenario, every setting spelled out."""
    table: dict[str, Any] = {"format": scenario.format, "title": scenario.title}
    if scenario.reference_radius_mm is not None:
        table["reference_radius_mm"] = scenario.reference_radius_mm
    for name in ("workshop", "placing", "instrument", "smr", "cmm", "work"):
        table[name] = getattr(scenario, name).model_dump(by_alias=True, exclude_none=True)
    if scenario.instruments:
        named = scenario.instruments.items()
        table["instruments"] = {name: i.model_dump(by_alias=True, exclude_none=True) for name, i in named}
    if scenario.gauge is not None:
        table["gauge"] = scenario.gauge.model_dump(by_alias=True, exclude_none=True)
    for kind in ("reflectors", "materials", "stations", "targets"):
        entries: dict[str, Section] = getattr(scenario, kind)
        table[kind] = {n: e.model_dump(by_alias=True, exclude_defaults=True) for n, e in entries.items()}
    for kind in ("lengths", "effects"):
        if listed := getattr(scenario, kind):
            table[kind] = [e.model_dump(by_alias=True, exclude_defaults=True) for e in listed]
    return to_toml(table)
