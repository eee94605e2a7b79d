"""The catalogue of physical effects, to look at."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ltsim.effects import CATALOGUE, Effect, find_effect
from ltsim.results import Columns, Result


@dataclass(frozen=True, repr=False)
class Catalogue(Result):
    """Effects of the catalogue; `effects` are their classes."""

    effects: tuple[type[Effect], ...]

    def _lines(self) -> list[str]:
        return [f"{effect.name}: {_meaning(effect)}" for effect in self.effects]

    def _tables(self) -> Mapping[str, Callable[[], Columns]]:
        return {"effects": self._effects, "parameters": self._parameters}

    def _effects(self) -> Columns:
        return {
            "effect": [e.name for e in self.effects],
            "observables": [", ".join(e.observables) for e in self.effects],
            "scope": [str(e.scope) for e in self.effects],
            "meaning": [_meaning(e) for e in self.effects],
        }

    def _parameters(self) -> Columns:
        listed = [(e, p) for e in self.effects for p in e.parameters]
        return {
            "effect": [e.name for e, _ in listed],
            "parameter": [p.name for _, p in listed],
            "plausible_size": [p.prior_sigma / p.factor for _, p in listed],
            "unit": [p.unit for _, p in listed],
            "meaning": [p.meaning for _, p in listed],
        }


def catalogue(*names: str) -> Catalogue:
    """The physical effects that can be simulated, calibrated and diagnosed, or some of them.

    Parameters
    ----------
    *names : str
        Default all.

    Raises
    ------
    ModelError
        When there is no such effect; the message names the closest ones.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.catalogue("beam-tilt").to_dataframe("parameters")[["parameter", "unit"]]
       parameter  unit
    0  beam-tilt  urad
    """
    return Catalogue(tuple(find_effect(name) for name in names) if names else tuple(CATALOGUE))


def _meaning(effect: type[Effect]) -> str:
    """What the effect is, in a sentence."""
    return (inspect.getdoc(effect) or "").partition("\n")[0]


def add_effect(kind: type[Effect]) -> type[Effect]:
    """Add an effect of your own for this session; also as a decorator of its class.

    From then on its name works wherever that of an effect does: in scenarios, in `with_effects`, in campaigns (their
    workers are told), in a diagnosis. A card is not needed; for other sessions put the class into a package.

    Parameters
    ----------
    kind : type of Effect
        With a name, a stage, parameters and `design`.

    Raises
    ------
    ModelError
        Why it cannot be an effect, or that the name is taken.

    Notes
    -----
    The page "An effect of your own" shows one that is simulated and fitted.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.add_effect(int)
    Traceback (most recent call last):
    ltsim.errors.ModelError: <class 'int'> cannot be an effect: it is no class derived from ltsim.effects.Effect
    """
    return CATALOGUE.add(kind)
