"""Descriptions of effects as data: the content of `ltsim effects --json`, of `lt.catalogue()`, and their tables."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping
from typing import Self

from pydantic import ConfigDict

from ltsim.core.descriptions import DescribedModel
from ltsim.core.results import Result, Table, model_columns, text_columns
from ltsim.core.units import SI_PER_UNIT
from ltsim.physics.effects.catalogue import BUILTIN_PROVIDER, DOCSTRING_SECTIONS, ListedEffect, catalogue_entry
from ltsim.physics.effects.effect import Parameter, ShapeParameter


class Description(DescribedModel):
    """Immutable description of an effect, or of a part of it."""

    model_config = ConfigDict(frozen=True)


class ParameterDescription(Description):
    """Parameter of an effect, which a calibration estimates."""

    name: str
    """Name of the parameter."""
    unit: str
    """Unit in which the parameter is displayed."""
    meaning: str
    """Definition of the parameter."""
    plausible_size: float
    """Size in a bad but plausible instrument or hall, in `unit`."""

    @classmethod
    def from_parameter(cls, parameter: Parameter) -> Self:
        """Description of a parameter."""
        size = parameter.prior_sigma / parameter.si_per_display_unit
        return cls(name=parameter.name, unit=parameter.unit, meaning=parameter.description, plausible_size=size)


class ConstantDescription(Description):
    """Constant of an effect (a length or time), for which a diagnosis searches between bounds."""

    name: str
    """Name of the constant."""
    unit: str
    """Unit in which the constant is displayed."""
    meaning: str
    """Definition of the constant."""
    lower_bound: float
    """Lower bound of the search, in `unit`."""
    upper_bound: float
    """Upper bound of the search, in `unit`."""

    @classmethod
    def from_constant(cls, constant: ShapeParameter) -> Self:
        """Description of a constant."""
        lower, upper = (bound / SI_PER_UNIT[constant.unit] for bound in (constant.lower_bound, constant.upper_bound))
        return cls(
            name=constant.name, unit=constant.unit, meaning=constant.description, lower_bound=lower, upper_bound=upper
        )


SECTION_FIELDS = ("typical_sizes", "similar_effects", "separate_by", "validity_domain", "literature", "validation")
"""Names of the fields of a description that contain the texts of `DOCSTRING_SECTIONS`, in the order of the sections."""


class EffectDescription(Description):
    """Description of an effect: its catalogue entry, and the properties and parameters of its class."""

    name: str
    """Name of the effect."""
    group: str
    """Group in the catalogue."""
    provider: str
    """Name and version of the package that provides the effect; `ltsim` for a built-in effect."""
    title: str
    """Name of the physical cause."""
    cause: str
    """Description of the physical cause."""
    equation: str
    """Equation of the effect with its sign."""
    typical_sizes: str
    """Sizes in a good and in a bad instrument or hall."""
    similar_effects: str
    """Effects with similar residuals, with the correlation of the residuals in the reference workshop for one face and
    for two faces."""
    separate_by: str
    """Measurements that distinguish the effect from similar effects."""
    validity_domain: str
    """Domain in which the equation holds."""
    literature: str
    """Publications from which the equation and the sizes are taken."""
    validation: str
    """Tests by which the equation was validated."""
    light_path_stage: str
    """Stage of the light path on which the effect acts."""
    scope: str
    """Set of pointings that share the parameters of the effect."""
    observables: tuple[str, ...]
    """Observables that the effect changes."""
    covariates: tuple[str, ...]
    """Quantities on which the effect depends."""
    base_rate: float
    """Relative frequency of the effect in practice; 1 is occasional."""
    meaning: str
    """Title and physical cause in one sentence."""
    parameters: tuple[ParameterDescription, ...]
    """Parameters of the effect, which a calibration estimates."""
    constants: tuple[ConstantDescription, ...]
    """Constants of the effect, for which a diagnosis searches."""

    @classmethod
    def from_listed_effect(cls, listed_effect: ListedEffect) -> Self:
        """Description of an effect of the catalogue."""
        effect = listed_effect.effect_class
        entry = catalogue_entry(effect)
        return cls(
            name=effect.name,
            group=listed_effect.group,
            provider=listed_effect.provider,
            title=entry.title,
            cause=entry.cause_description,
            equation=entry.equation,
            **dict(zip(SECTION_FIELDS, entry.section_texts, strict=True)),
            light_path_stage=effect.light_path_stage.name.lower(),
            scope=effect.scope,
            observables=effect.observables,
            covariates=effect.covariates,
            base_rate=effect.base_rate,
            meaning=(inspect.getdoc(effect) or "").partition("\n")[0],
            parameters=tuple(ParameterDescription.from_parameter(p) for p in effect.parameters),
            constants=tuple(ConstantDescription.from_constant(s) for s in effect.shape_parameters),
        )

    @property
    def labelled_texts(self) -> tuple[tuple[str, str], ...]:
        """Pairs (label, text) below the equation: sections of the catalogue entry, then properties of the class."""
        pairs = (
            *zip(DOCSTRING_SECTIONS, (getattr(self, field) for field in SECTION_FIELDS), strict=True),
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
        """Title and physical cause."""
        return f"{self.title}: {self.cause}"

    @property
    def external_provider(self) -> str:
        """Name and version of the package that provides the effect; empty for a built-in effect of ltsim."""
        return "" if self.provider == BUILTIN_PROVIDER else self.provider

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
EFFECT_CONSTANTS_TABLE = Table(
    "constants.csv",
    "constants of effects, for which a diagnosis searches",
    (
        *text_columns(effect="name of the effect"),
        *model_columns(
            ConstantDescription,
            "name lower_bound upper_bound unit meaning",
            name={"name": "constant"},
            lower_bound={"title": "searched from", "display_format": ".4g"},
            upper_bound={"title": "to", "display_format": ".4g"},
        ),
    ),
)


@dataclasses.dataclass(frozen=True, repr=False)
class EffectList(Result):
    """List of effects of the catalogue, with their parameters and constants."""

    descriptions: tuple[EffectDescription, ...]
    """Descriptions of the effects, in the order of the catalogue or of the request."""

    def _summary_lines(self) -> list[str]:
        return [f"{effect.name}: {effect.meaning}" for effect in self.descriptions]

    def _table_makers(self) -> Mapping[str, Callable[[], Table]]:
        return {
            "effects": lambda: CATALOGUE_TABLE.with_rows(self.descriptions),
            "parameters": lambda: EFFECT_PARAMETERS_TABLE.with_rows(
                (e.name, p.name, p.plausible_size, p.unit, p.meaning) for e in self.descriptions for p in e.parameters
            ),
            "constants": lambda: EFFECT_CONSTANTS_TABLE.with_rows(
                (e.name, s.name, s.lower_bound, s.upper_bound, s.unit, s.meaning)
                for e in self.descriptions
                for s in e.constants
            ),
        }
