"""Descriptions of effects as data, for `ltsim effects --json`, `lt.catalogue()` and their tables."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Self

from pydantic import ConfigDict

from ltsim.core.descriptions import DescribedModel
from ltsim.core.results import Result, Table, model_columns, text_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.catalogue import BUILTIN_PROVIDER_NAME, DOCSTRING_SECTIONS, ListedEffect, catalogue_entry
from ltsim.physics.effects.effect import Parameter, ShapeParameter


class Description(DescribedModel):
    """Base class of immutable descriptions: of an effect, of a parameter, or of a shape parameter."""

    model_config = ConfigDict(frozen=True)


class ParameterDescription(Description):
    """Description of a parameter of an effect, which a calibration estimates."""

    name: str
    """Name of the parameter."""
    unit: str
    """Display unit of the parameter."""
    meaning: str
    """Definition of the parameter."""
    plausible_size: float
    """Size of the parameter in a bad but plausible instrument or hall, in `unit`."""

    @classmethod
    def from_parameter(cls, parameter: Parameter) -> Self:
        """Description of a parameter of an effect in its display unit."""
        size = parameter.prior_sigma / parameter.si_per_display_unit
        return cls(name=parameter.name, unit=parameter.unit, meaning=parameter.description, plausible_size=size)


class ShapeParameterDescription(Description):
    """Description of a shape parameter of an effect (such as a time constant), which a diagnosis searches."""

    name: str
    """Name of the shape parameter."""
    unit: str
    """Display unit of the shape parameter."""
    meaning: str
    """Definition of the shape parameter."""
    lower_bound: float
    """Smallest value of the shape parameter that a diagnosis tries, in `unit`."""
    upper_bound: float
    """Largest value of the shape parameter that a diagnosis tries, in `unit`."""

    @classmethod
    def from_shape_parameter(cls, shape_parameter: ShapeParameter) -> Self:
        """Description of a shape parameter of an effect in its display unit."""
        lower, upper = (
            bound / SI_PER_UNIT[shape_parameter.unit]
            for bound in (shape_parameter.lower_bound, shape_parameter.upper_bound)
        )
        return cls(
            name=shape_parameter.name,
            unit=shape_parameter.unit,
            meaning=shape_parameter.description,
            lower_bound=lower,
            upper_bound=upper,
        )


SECTION_FIELD_NAMES = ("typical_sizes", "similar_effects", "separate_by", "validity_domain", "literature", "validation")
"""Names of the fields of `EffectDescription` that contain the sections of a catalogue entry, in the order of
`DOCSTRING_SECTIONS`."""


class EffectDescription(Description):
    """Description of an effect of the catalogue: its catalogue entry, and the properties of its class."""

    name: str
    """Name of the effect."""
    group: str
    """Group in which the catalogue lists the effect."""
    provider: str
    """Name and version of the package that provides the effect; `ltsim` for a built-in effect."""
    title: str
    """Title of the effect: the name of its physical cause."""
    cause: str
    """Description of the physical cause of the effect."""
    equation: str
    """Equation of the effect with its sign."""
    typical_sizes: str
    """Sizes of the effect in a good and in a bad instrument or hall."""
    similar_effects: str
    """Effects with similar residuals, with the correlation of the residuals in the reference workshop for one face and
    for two faces."""
    separate_by: str
    """Measurements that distinguish the effect from similar effects."""
    validity_domain: str
    """Domain in which the equation of the effect holds."""
    literature: str
    """Publications with the equation and the sizes of the effect."""
    validation: str
    """Tests of the equation of the effect."""
    light_path_stage: str
    """Stage of the light path (such as air or encoders) at which the effect acts."""
    scope: str
    """Part of the recording, such as a station, in which one instance of the effect acts with separate parameters."""
    observables: tuple[str, ...]
    """Observables that the effect changes."""
    covariates: tuple[str, ...]
    """Quantities, such as time or elevation, on which the effect depends."""
    base_rate: float
    """Relative frequency of the effect in practice: 8 very common, 1 occasional, 0.5 rare."""
    meaning: str
    """Title and physical cause of the effect in one sentence."""
    parameters: tuple[ParameterDescription, ...]
    """Parameters of the effect, which a calibration estimates."""
    constants: tuple[ShapeParameterDescription, ...]
    """Shape parameters of the effect (such as a time constant), which a diagnosis searches."""

    @classmethod
    def from_listed_effect(cls, listed_effect: ListedEffect) -> Self:
        """Description of an effect with its group and provider in the catalogue."""
        effect = listed_effect.effect_class
        entry = catalogue_entry(effect)
        return cls(
            name=effect.name,
            group=listed_effect.group,
            provider=listed_effect.provider,
            title=entry.title,
            cause=entry.cause_description,
            equation=entry.equation,
            **dict(zip(SECTION_FIELD_NAMES, entry.section_texts, strict=True)),
            light_path_stage=effect.light_path_stage.name.lower(),
            scope=effect.scope,
            observables=effect.observables,
            covariates=effect.covariates,
            base_rate=effect.base_rate,
            meaning=(inspect.getdoc(effect) or "").partition("\n")[0],
            parameters=tuple(ParameterDescription.from_parameter(p) for p in effect.parameters),
            constants=tuple(ShapeParameterDescription.from_shape_parameter(s) for s in effect.shape_parameters),
        )

    @property
    def labelled_texts(self) -> tuple[tuple[str, str], ...]:
        """Pairs of label and text of a catalogue entry below its equation: sections, then properties of the effect."""
        pairs = (
            *zip(DOCSTRING_SECTIONS, (getattr(self, field) for field in SECTION_FIELD_NAMES), strict=True),
            ("Acts on", self.observables_text),
            ("Scope", self.scope),
            ("Stage", self.light_path_stage),
            ("Base rate", f"{self.base_rate:g} (relative frequency in service; 1 is occasional)"),
            ("Depends on", ", ".join(self.covariates)),
            ("Comes from", self.external_provider),
        )
        return tuple((label, text) for label, text in pairs if text)

    @property
    def summary(self) -> str:
        """Title and physical cause of the effect, separated by a colon."""
        return f"{self.title}: {self.cause}"

    @property
    def external_provider(self) -> str:
        """Name and version of the package that provides the effect; empty for a built-in effect of ltsim."""
        return "" if self.provider == BUILTIN_PROVIDER_NAME else self.provider

    @property
    def observables_text(self) -> str:
        """Names of the observables that the effect changes, separated by commas."""
        return ", ".join(self.observables)


CATALOGUE_TABLE = Table(
    "effects.csv",
    "effects of the catalogue",
    model_columns(
        EffectDescription,
        "name observables scope base_rate meaning",
        name={"name": "effect"},
        observables={"row_attribute": "observables_text", "kind": "text"},
    ),
)
EFFECT_PARAMETERS_TABLE = Table(
    "parameters.csv",
    "parameters of effects",
    (
        *text_columns(effect="name of the effect"),
        *model_columns(
            ParameterDescription,
            "name plausible_size unit meaning",
            name={"name": "parameter"},
            plausible_size={"display_format": ".3g"},
        ),
    ),
)
EFFECT_SHAPE_PARAMETERS_TABLE = Table(
    "constants.csv",
    "shape parameters of effects, which a diagnosis searches",
    (
        *text_columns(effect="name of the effect"),
        *model_columns(
            ShapeParameterDescription,
            "name lower_bound upper_bound unit meaning",
            name={"name": "constant"},
            lower_bound={"title": "searched from", "display_format": ".4g"},
            upper_bound={"title": "to", "display_format": ".4g"},
        ),
    ),
)


@dataclasses.dataclass(frozen=True, repr=False)
class EffectList(Result):
    """List of effects of the catalogue, with their parameters and shape parameters."""

    descriptions: tuple[EffectDescription, ...]
    """Descriptions of the listed effects, in the order of the catalogue or of the user's request."""

    def _summary_lines(self) -> list[str]:
        return [f"{effect.name}: {effect.meaning}" for effect in self.descriptions]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "effects": lambda: CATALOGUE_TABLE.with_rows(self.descriptions),
            "parameters": lambda: EFFECT_PARAMETERS_TABLE.with_rows(
                (e.name, p.name, p.plausible_size, p.unit, p.meaning) for e in self.descriptions for p in e.parameters
            ),
            "constants": lambda: EFFECT_SHAPE_PARAMETERS_TABLE.with_rows(
                (e.name, s.name, s.lower_bound, s.upper_bound, s.unit, s.meaning)
                for e in self.descriptions
                for s in e.constants
            ),
        }
