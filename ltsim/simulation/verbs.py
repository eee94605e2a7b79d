"""Public functions of the simulation: `scenario` and `simulate`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

from ltsim.core.arguments import (
    check_argument_bounds,
    check_argument_choice,
    check_mapping_argument,
    path_of_file_or_built_in,
)
from ltsim.recordings import Recording
from ltsim.simulation.scenario import Scenario, change_scenario, load_scenario
from ltsim.simulation.simulator import GeometrySharing, simulate as measured
from ltsim.simulation.truth import Truth

ScenarioSource = Scenario | str | Path
"""Argument that names a scenario: a `Scenario`, the path of its file, or the name of a built-in scenario."""


class SimulatedRecording(NamedTuple):
    """Simulated recording and its true values."""

    recording: Recording
    truth: Truth


def scenario(source: ScenarioSource, changes: Mapping[str, Any] | None = None) -> Scenario:
    """Scenario, built-in or from a file, with new values for the keys in `changes`.

    Parameters
    ----------
    source : Scenario, str or Path
        Scenario, its file, or the name of a built-in scenario.
    changes : mapping of str to value, optional
        New values by dotted key, as in the file: ``{"instrument.noise_factor": 2.0}``; "none" removes a key. Effects
        can be objects, whose sizes are drawn: ``{"effects": [lt.Effect("index-drift", stations="S3")]}``.

    Raises
    ------
    InputError
        When the scenario does not exist or a value is invalid; the message names file, key, value and what is expected.

    Examples
    --------
    >>> import ltsim as lt
    >>> lt.scenario("paper-workshop", {"work.faces": 2})
    Scenario: The paper's workshop: 5 stations, 28 targets, two faces, no effects
    """
    check_mapping_argument("changes", changes)
    if isinstance(source, Scenario):
        return change_scenario(source, changes, Path(source.title or "the scenario")) if changes else source
    loaded = load_scenario(path_of_file_or_built_in(source))
    return change_scenario(loaded, changes, Path(source)) if changes else loaded


def simulate(
    source: ScenarioSource = "paper-workshop",
    *,
    seed: int = 0,
    trial: int = 0,
    geometry: GeometrySharing = "shared",
    changes: Mapping[str, Any] | None = None,
) -> SimulatedRecording:
    """Simulated recording of a scenario, and its true values.

    Parameters
    ----------
    source : Scenario, str or Path
        Scenario, its file, or the name of a built-in scenario.
    seed : int
        Seed of all random draws: equal seed and trial give the same recording.
    trial : int
        Number of the trial in a campaign of this scenario and seed. The calibration of the recording equals the row of
        that trial in the campaign's results.
    geometry : {`shared`, `per-trial`}
        Positions of stations and targets: one draw shared by all trials, or a separate draw for each trial.
    changes : mapping of str to value, optional
        New values by dotted key, as in `lt.scenario`.

    Returns
    -------
    recording : Recording
    truth : Truth
        True values, which no calibration or diagnosis reads.

    Raises
    ------
    InputError
        When the scenario is impossible, for example if a station sees no target.

    Examples
    --------
    >>> import ltsim as lt
    >>> recording, truth = lt.simulate("paper-workshop", seed=7)
    >>> recording.to_dataframe().head(1)[["station", "target", "distance_mm"]].round(1)
      station target  distance_mm
    0      S1    T06       5003.3
    >>> truth.to_dataframe("instrument").shape
    (16, 3)
    """
    check_argument_bounds(seed=seed, trial=trial, required_argument="seed trial")
    check_argument_choice("geometry", geometry, get_args(GeometrySharing))
    return SimulatedRecording(*measured(scenario(source, changes), seed, trial, geometry))
