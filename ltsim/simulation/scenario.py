"""Scenario: all inputs of a simulation except the seed, in an editable file."""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from ltsim.core.arrays import Floats
from ltsim.core.errors import InputError, reraise_as_input_error
from ltsim.core.results import Result
from ltsim.physics.effects.dead_path import AIR_TEMPERATURE_COLUMN
from ltsim.physics.effects.effect import Effect
from ltsim.physics.effects.verbs import SizedEffect, make_effect
from ltsim.recordings.air import AirUncertainty
from ltsim.recordings.files import SourceLocation, safe_excerpt
from ltsim.recordings.settings import merge_defaults, read_toml, to_toml, validate_settings, with_completed_instruments
from ltsim.recordings.setup import Material, NonNegative, Reflector, TomlSection
from ltsim.recordings.specification import data_sheet_names, noise_and_prior_tables
from ltsim.simulation.builtin import builtin_names, builtin_path
from ltsim.simulation.sections import (
    TRACKER_PRESETS,
    CoordinateMeasuringMachine,
    EffectEntry,
    MeasurementProcedure,
    PlacingSigmas,
    PlannedStation,
    PlannedTarget,
    PointingLimits,
    ReferenceLengthEntry,
    ScenarioGauge,
    ScenarioInstrument,
    Smr,
    Workshop,
)

SCENARIO_FORMAT = "ltsim-scenario/1"
"""Format and version of a scenario file."""
MIN_SCENARIO_TARGETS = 3
"""Smallest number of targets in a scenario, including the reflectors of the gauge."""
MAX_NAMES_IN_ERROR = 12
"""Largest number of names that an error message lists."""
ALWAYS_WRITTEN_KEYS = (
    "format", "title", "reference_radius_mm", "workshop", "placing", "instrument", "smr", "cmm", "work", "instruments",
    "gauge", "air",
)  # fmt: skip
"""Keys that are written to a scenario file even if they have their default values."""
KEY_REMOVAL_VALUE = "none"
"""Value that removes a key which the built-in base scenario sets, as in ``gauge = "none"``."""


class Scenario(TomlSection, Result):
    """Scenario of a simulation: all its inputs except the seed, with the content of the scenario file."""

    format: Literal["ltsim-scenario/1"] = "ltsim-scenario/1"
    """Format and version of this file."""
    title: str = ""
    """Title of the scenario, free text."""
    base: str | None = None
    """Built-in scenario that supplies missing tables and keys; a key with the value "none" removes the key of this
    built-in scenario."""
    workshop: Workshop = Workshop()
    """Hall, air and obstacles."""
    placing: PlacingSigmas = PlacingSigmas()
    """Standard deviations of true minus planned positions."""
    instrument: ScenarioInstrument = ScenarioInstrument()
    """Tracker of all stations that name no tracker."""
    instruments: dict[str, ScenarioInstrument] = Field(default_factory=dict)
    """Trackers by the name to which stations refer, tables `[instruments.NAME]`; all have the same `construction`."""
    smr: Smr = Smr()
    """Orientation and range error of the reflectors."""
    reflectors: dict[str, Reflector] = Field(default_factory=dict)
    """SMRs with individual radii, tables `[reflectors.NAME]`; each target or station names one of them. An SMR whose
    radius differs from the reference radius is displaced along the normal of its nest. The true radius is drawn."""
    reference_radius_mm: NonNegative | None = None
    """Radius of the SMR whose centre the planned positions describe; 0 if they describe the nest seats. The recording's
    `setup.toml` contains a copy."""
    cmm: CoordinateMeasuringMachine = CoordinateMeasuringMachine()
    """Coordinate measuring machine that calibrated the gauge (frame of reflectors at known distances)."""
    work: MeasurementProcedure = MeasurementProcedure()
    """Order and timing of the measurements."""
    gauge: ScenarioGauge | None = None
    """Gauge, a rigid frame of reflectors at known distances (reference lengths); None for a scenario without gauge."""
    materials: dict[str, Material] = Field(default_factory=dict)
    """Materials of reference lengths, tables `[materials.NAME]`; their true expansion coefficients are drawn."""
    lengths: tuple[ReferenceLengthEntry, ...] = ()
    """Reference lengths between reflectors that are not on the gauge, tables `[[lengths]]`."""
    stations: dict[str, PlannedStation]
    """Set-ups in the order of measurement, tables `[stations.NAME]`."""
    targets: dict[str, PlannedTarget] = Field(default_factory=dict)
    """Reflectors, tables `[targets.NAME]`."""
    air: AirUncertainty | None = None
    """Uncertainty of the air along the beams, as the recording declares it (table `[air]`); it does not change
    readings."""
    effects: tuple[EffectEntry, ...] = ()
    """Effects that change the readings in addition to the instrument's errors, tables `[[effects]]`."""

    @property
    def target_names(self) -> tuple[str, ...]:
        """Names of the targets: reflectors of the tables `[targets.NAME]`, then reflectors of the gauge."""
        return (*self.targets, *(self.gauge.targets if self.gauge else ()))

    @property
    def trackers_in_use(self) -> dict[str, ScenarioInstrument]:
        """Trackers in use by name, in the order of `Recording.instruments`; '' for a tracker without a name."""
        names = sorted({station.instrument or "" for station in self.stations.values()})
        return {name: self.instruments[name] if name else self.instrument for name in names}

    def stations_of_tracker(self, tracker: str) -> tuple[str, ...]:
        """Names of the stations at which the tracker named `tracker` stands."""
        return tuple(name for name, station in self.stations.items() if (station.instrument or "") == tracker)

    def _summary_lines(self) -> list[str]:
        title = f"{self.title}: " if self.title else ""
        faces = "two faces" if self.work.faces == 2 else "one face"
        effects = ", ".join(entry.name for entry in self.effects) or "no effects"
        trackers = f" by {len(self.trackers_in_use)} trackers" if len(self.trackers_in_use) > 1 else ""
        measured = f"{len(self.stations)} stations{trackers}, {len(self.target_names)} targets"
        return [f"Scenario: {title}{measured}, {faces}, {effects}"]

    __repr__ = __str__ = Result.__repr__


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Built-in scenario with the given name, or scenario in a file or in the folder of a plan; raises InputError."""
    path, name = Path(name_or_path), str(name_or_path)
    if (path / "plan.json").is_file():
        path = path / "scenario.toml"
    if name in builtin_names() or not path.exists():
        path = builtin_path(name)
    with reraise_as_input_error():
        data = read_toml(path, "scenario")
    return validate_scenario(data, path)


def validate_scenario(tables: Mapping[str, Any], file: Path) -> Scenario:
    """Validated scenario from its TOML tables; errors name `file`, whose folder contains the CAD files."""
    with reraise_as_input_error():
        completed_tables = with_completed_instruments(_with_base(tables), lambda table, _: _with_preset(table, file))
        scenario = validate_settings(completed_tables, Scenario, "scenario", file)
    _check_scenario(scenario, file)
    return _resolve_paths(_with_reduced_network(scenario, file), file)


def change_scenario(scenario: Scenario, changes: Mapping[str, Any], file: Path, error_location: str = "") -> Scenario:
    """Validated scenario with new values `changes` by dotted key; errors name `file` and `error_location`.

    A new `preset` of a tracker also sets the noise, the prior of the instrument errors, and the limits of the tracker.
    InputError is raised for an invalid key or value.
    """
    # Validated twice: the tables with the changes, and the file that would be written from the result.
    table = scenario.model_dump(mode="json", by_alias=True, exclude_none=True)
    of_presets = sorted({section for sections in TRACKER_PRESETS.values() for section in sections})
    brought = [f"{key.removesuffix('preset')}{s}" for key in changes if key.endswith(".preset") for s in of_presets]
    of_sheets = [key for key, value in changes.items() if key.endswith(".preset") and value in data_sheet_names()]
    brought += [key.removesuffix("preset") + "limits" for key in of_sheets]
    for key, value in [*((key, KEY_REMOVAL_VALUE) for key in brought), *changes.items()]:
        _assign_dotted_key(table, key, _toml_value(value, effects=key == "effects"), error_location or str(file))
    return validate_scenario(table, file)


def _toml_value(value: Any, *, effects: bool) -> Any:
    """Value of a key as in a TOML file; if `effects` is true, effect objects and names of effects become tables."""
    if isinstance(value, Effect | SizedEffect) or (effects and isinstance(value, str)):
        value = [value]
    if not isinstance(value, (list, tuple)):
        return value
    given = [make_effect(v, {}, {}) if effects and isinstance(v, str) else v for v in value]
    entries = (EffectEntry.from_effect(v) if isinstance(v, Effect | SizedEffect) else v for v in given)
    return [e.model_dump(mode="json", exclude_defaults=True) if isinstance(e, EffectEntry) else e for e in entries]


def _assign_dotted_key(table: dict[str, Any], key: str, value: Any, error_location: str) -> None:
    """Assignment of a value to one dotted key in nested tables.

    Entries of lists are numbered from 1. The value `KEY_REMOVAL_VALUE` removes the key.
    """
    *parents, last = key.split(".")
    subtable: Any = table
    for name in parents:
        if isinstance(subtable, list) and name.isdecimal() and 1 <= int(name) <= len(subtable):
            subtable = subtable[int(name) - 1]
        else:
            subtable = subtable.setdefault(name, {}) if isinstance(subtable, dict) else None
        if not isinstance(subtable, (dict, list)):
            through = f"{safe_excerpt(key)} contains the part {safe_excerpt(name)}"
            raise InputError(f"{error_location}: {through}, which is not a table of the scenario")
    if not isinstance(subtable, dict):
        wanted = f"{'.'.join(parents)}.NUMBER.KEY, where the first entry of the list has the number 1"
        raise InputError(f"{error_location}: {safe_excerpt(key)} is not a key of a list entry; expected {wanted}")
    if value == KEY_REMOVAL_VALUE:
        subtable.pop(last, None)
    else:
        subtable[last] = value


def _with_base(tables: Mapping[str, Any]) -> Mapping[str, Any]:
    """TOML tables of a scenario, completed by those of the built-in scenario that the key `base` names."""
    if tables.get("base") is None:
        return tables
    below = _with_base(read_toml(builtin_path(str(tables["base"])), "scenario"))
    merged_tables = merge_defaults(tables, below)
    return {key: value for key, value in merged_tables.items() if key != "base" and value != KEY_REMOVAL_VALUE}


def _with_preset(instrument: Any, file: Path) -> Any:
    """TOML table of an instrument, completed by the values of its preset; errors name `file`."""
    if not isinstance(instrument, dict):
        return instrument
    name = instrument.get("preset")
    if name not in data_sheet_names():
        return merge_defaults(instrument, TRACKER_PRESETS.get(str(name), {}))
    with reraise_as_input_error(f"{file}: instrument.preset"):
        below = noise_and_prior_tables(name, instrument, PointingLimits.model_fields)
    return merge_defaults(instrument, below)


def _with_reduced_network(scenario: Scenario, file: Path) -> Scenario:
    """Scenario reduced to ``work.stations`` stations and to ``work.targets`` targets that are not on the gauge.

    Excluded stations and targets are removed from effects, and trackers without a station are removed. InputError is
    raised if too many are requested, or if fewer than three targets remain.
    """
    work = scenario.work
    for key in ("stations", "targets"):
        wanted, there = getattr(work, key), len(getattr(scenario, key))
        if wanted is not None and wanted > there:
            raise InputError(
                f"{file}: work.{key} is {wanted}, but the scenario has {there}; add {key}, or request fewer"
            )
    stations = dict(list(scenario.stations.items())[: work.stations])
    targets = scenario.targets if work.targets is None else _select_spread_targets(scenario.targets, work.targets)
    gauge = scenario.gauge.targets if scenario.gauge else ()
    if len(targets) + len(gauge) < MIN_SCENARIO_TARGETS:
        least = MIN_SCENARIO_TARGETS - len(gauge)
        raise InputError(f"{file}: work.targets is {work.targets}, expected at least {least} of the reflectors")
    if len(stations) == len(scenario.stations) and len(targets) == len(scenario.targets):
        return scenario
    used_instruments = {station.instrument for station in stations.values()}
    return scenario.model_copy(
        update={
            "stations": stations,
            "targets": targets,
            "instruments": {name: i for name, i in scenario.instruments.items() if name in used_instruments},
            "lengths": tuple(bar for bar in scenario.lengths if {bar.from_, bar.to} <= {*targets}),
            "effects": tuple(_effects_of_network(scenario.effects, {*stations}, {*targets, *gauge})),
        }
    )


def _effects_of_network(effects: Sequence[EffectEntry], stations: set[str], targets: set[str]) -> Iterator[EffectEntry]:
    """Effects restricted to the remaining `stations` and `targets`, without effects that act at none of these."""
    for entry in effects:
        here = tuple(name for name in entry.stations if name in stations)
        at = tuple(name for name in entry.targets if name in targets)
        if bool(here) == bool(entry.stations) and bool(at) == bool(entry.targets):
            yield entry.model_copy(update={"stations": here, "targets": at})


def _select_spread_targets(targets: Mapping[str, PlannedTarget], n_targets: int) -> dict[str, PlannedTarget]:
    """Selection of `n_targets` widely distributed targets, in file order (Gonzalez 1985: farthest-point selection)."""
    places = np.array([t.position_mm for t in targets.values()], dtype=np.float64).reshape(-1, 3)
    selected_targets = set(space_filling_order(places)[:n_targets])
    return {name: target for i, (name, target) in enumerate(targets.items()) if i in selected_targets}


def space_filling_order(points: Floats) -> list[int]:
    """Indices of points (points, 3) in an order in which each point is as far as possible from all previous ones."""
    order: list[int] = []
    gap = np.linalg.norm(points - points.mean(axis=0), axis=1) if len(points) else np.zeros(0)
    for _ in range(len(points)):
        order.append(int(np.argmax(gap)))
        reach = np.linalg.norm(points - points[order[-1]], axis=1)
        gap = reach if len(order) == 1 else np.minimum(gap, reach)
        gap[order] = -1.0
    return order


def _resolve_paths(scenario: Scenario, file: Path) -> Scenario:
    """Scenario with the paths of its CAD files relative to the folder of its file."""
    obstacles = tuple(
        o if o.file is None else o.model_copy(update={"file": str(_local_path(o.file, file.parent))})
        for o in scenario.workshop.obstacles
    )
    if not any(o.file for o in obstacles):
        return scenario
    return scenario.model_copy(update={"workshop": scenario.workshop.model_copy(update={"obstacles": obstacles})})


def _local_path(file_name: str, folder: Path) -> Path:
    named, copied = folder / file_name, folder / Path(file_name).name
    return copied if copied.is_file() and not named.is_file() else named


def _check_scenario(scenario: Scenario, file: Path) -> None:
    for problem in chain(
        _invalid_name_sentences(scenario, file),
        _invalid_tracker_sentences(scenario),
        _invalid_position_sentences(scenario),
        _invalid_length_sentences(scenario),
        _invalid_effect_sentences(scenario),
    ):
        raise InputError(f"{file}: {problem}")


def unknown_name_sentences(key: str, name: str, names: Collection[str], list_text_if_empty: str = "") -> Iterator[str]:
    """Sentence if `name`, the value of `key`, is not one of `names`; `list_text_if_empty` replaces an empty list."""
    if name not in names:
        listed = ", ".join([*names][:MAX_NAMES_IN_ERROR]) + (" ..." if len(names) > MAX_NAMES_IN_ERROR else "")
        yield f"{key} names '{safe_excerpt(name)}', which is not one of {listed or list_text_if_empty}"


def _invalid_name_sentences(scenario: Scenario, file: Path) -> Iterator[str]:
    names = scenario.target_names
    if not scenario.stations:
        yield "stations is empty, expected at least one table [stations.NAME]"
    if len(names) < MIN_SCENARIO_TARGETS:
        yield f"targets has {len(names)} reflectors including the gauge, expected at least {MIN_SCENARIO_TARGETS}"
    for name, count in Counter(names).items():
        if count > 1:
            yield f"gauge.targets names '{safe_excerpt(name)}' twice, or it is also a table of [targets]"
    for kind, listed in (("station", scenario.stations), ("target", names), ("instrument", scenario.instruments)):
        for name in listed:
            with reraise_as_input_error():
                SourceLocation(file).checked_name(name, kind)


def _invalid_tracker_sentences(scenario: Scenario) -> Iterator[str]:
    """Sentences on stations with unknown trackers, trackers without stations, and trackers with different models."""
    used = {name: station.instrument for name, station in scenario.stations.items() if station.instrument is not None}
    for station, name in used.items():
        if not scenario.instruments:
            yield f"stations.{station}.instrument names '{safe_excerpt(name)}', which is not declared"
        yield from unknown_name_sentences(f"stations.{station}.instrument", name, scenario.instruments)
    for name in scenario.instruments:
        if name not in used.values():
            yield f"instruments.{safe_excerpt(name)} is used at no station; name it as the instrument of a station"
    if "" not in scenario.trackers_in_use and scenario.instrument != ScenarioInstrument():
        yield "instrument is used at no station: every station names another instrument"
    designs = {name: (i.construction, i.harmonics, i.degree) for name, i in scenario.trackers_in_use.items()}
    (first, first_design), *others = designs.items()
    for name, other in others:
        if other != first_design:
            designs_named = " and ".join(f"{tracker_table_name(n)} '{designs[n][0]}'" for n in (first, name))
            yield f"instruments have different constructions or orders ({designs_named}); give all the same"


def _invalid_position_sentences(scenario: Scenario) -> Iterator[str]:
    hall_size_mm = scenario.workshop.size_mm
    placed = {f"stations.{name}": station.position_mm for name, station in scenario.stations.items()}
    placed |= {f"targets.{name}": target.position_mm for name, target in scenario.targets.items()}
    placed |= {"gauge": scenario.gauge.position_mm} if scenario.gauge else {}
    for key, place in placed.items():
        if any(not -1.0 <= x <= high + 1.0 for x, high in zip(place, hall_size_mm, strict=True)):
            hall = " x ".join(f"{x:g}" for x in hall_size_mm)
            where = f"outside the hall of {hall} mm whose corner is the origin"
            yield f"{key}.position_mm is {list(place)}, {where}"
    for name, target in scenario.targets.items():
        if target.nest_normal is not None and not any(target.nest_normal):
            yield f"targets.{name}.nest_normal has length 0"


def _invalid_length_sentences(scenario: Scenario) -> Iterator[str]:
    """Sentences on invalid reference lengths: wrong ends, undeclared material, or invalid temperature."""
    for i, length in enumerate(scenario.lengths, 1):
        for key, name in (("from", length.from_), ("to", length.to)):
            yield from unknown_name_sentences(f"lengths.{i}.{key}", name, scenario.targets)
        if length.from_ == length.to:
            yield f"lengths.{i} goes from '{safe_excerpt(length.to)}' to itself, expected two different targets"
        if length.material is not None:
            none_hint = "none, and a table [materials.NAME] defines one"
            yield from unknown_name_sentences(f"lengths.{i}.material", length.material, scenario.materials, none_hint)
        if isinstance(length.measured_at_c, str) and length.measured_at_c != AIR_TEMPERATURE_COLUMN:
            given = safe_excerpt(length.measured_at_c)
            yield f"lengths.{i}.measured_at_c is '{given}', expected a number or '{AIR_TEMPERATURE_COLUMN}'"


def _invalid_effect_sentences(scenario: Scenario) -> Iterator[str]:
    for i, entry in enumerate(scenario.effects, 1):
        for name in entry.stations:
            yield from unknown_name_sentences(f"effects.{i}.stations", name, scenario.stations)
        for name in entry.targets:
            yield from unknown_name_sentences(f"effects.{i}.targets", name, scenario.target_names)


def tracker_table_name(tracker_name: str) -> str:
    """Name of the table of a tracker in the scenario's file; the tracker without a name has the table `instrument`."""
    return f"instruments.{tracker_name}" if tracker_name else "instrument"


def scenario_to_toml(scenario: Scenario) -> str:
    """TOML text of a scenario with all its values; `load_scenario` reads the same scenario from it."""
    scenario_tables = scenario.model_dump(by_alias=True, exclude_none=True)
    brief = scenario.model_dump(by_alias=True, exclude_defaults=True)
    table: dict[str, Any] = {name: scenario_tables[name] for name in ALWAYS_WRITTEN_KEYS if name in scenario_tables}
    table |= {kind: brief.get(kind, {}) for kind in ("reflectors", "materials", "stations", "targets")}
    return to_toml(table | {kind: brief[kind] for kind in ("lengths", "effects") if kind in brief})
