"""What a campaign may vary: links, counts, designs, values with units, and how its cells are called."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ltsim.campaigns.design import ScenarioKeyRange, cell_label, short_key_names
from ltsim.campaigns.spec import load_campaign, make_campaign_cells
from ltsim.core.errors import InputError

HEAD = 'format = "ltsim-campaign/1"\ntrials = 2\n'
RANGE = '[design.ranges."work.targets"]\n'
LINK = '[linked_keys]\nnoise_arcsec = ["instrument.noise.azimuth_arcsec", "instrument.noise.elevation_arcsec"]\n'


def made(tmp_path: Path, text: str):
    file = tmp_path / "made.toml"
    file.write_text(HEAD + text)
    campaign, scenarios = load_campaign(file)
    factors, cells = make_campaign_cells(campaign, scenarios, file)
    return campaign, scenarios, factors, [cell.levels for cell in cells]


def test_each_usual_factor_is_a_single_key(tmp_path: Path) -> None:
    grid = (
        '[grid]\n"work.targets" = [6, 12]\n"work.stations" = [3, 5]\n"work.faces" = [1, 2]\n"work.repeats" = [1, 3]\n'
    )
    _, scenarios, factors, levels = made(tmp_path, grid)
    assert [f.name for f in factors] == ["targets", "stations", "faces", "repeats"]
    assert {f.kind for f in factors} == {"integer"}
    assert len(scenarios) == 16 and levels[0] == {"targets": 6, "stations": 3, "faces": 1, "repeats": 1}
    assert [(len(s.targets), len(s.stations)) for s in scenarios[::4]] == [(6, 3), (6, 5), (12, 3), (12, 5)]
    assert set(scenarios[0].targets) < set(scenarios[8].targets)
    assert list(scenarios[0].stations) == ["S1", "S2", "S3"]


def test_linked_keys_take_the_same_value_in_the_keys_unit(tmp_path: Path) -> None:
    _, scenarios, factors, levels = made(tmp_path, LINK + '[grid]\nnoise_arcsec = [0.5, "4.848136811 urad"]\n')
    assert [(f.name, f.unit, len(f.keys)) for f in factors] == [("noise_arcsec", "arcsec", 2)]
    assert [x["noise_arcsec"] for x in levels] == [0.5, pytest.approx(1.0)]
    for scenario, angle in zip(scenarios, (0.5, 1.0), strict=True):
        noise = scenario.instrument.noise
        assert (noise.azimuth_arcsec, noise.elevation_arcsec) == (pytest.approx(angle),) * 2
    assert cell_label(factors, levels[0]) == "noise_arcsec = 0.5"


def test_errors_and_effects_are_swept_in_their_units(tmp_path: Path) -> None:
    text = '[scenario_changes]\n"workshop.temperature_c" = "27 °C"\neffects = [{name = "head-sag"}]\n'
    text += '[grid]\n"instrument.errors.beam-tilt" = ["1 arcsec"]\n"effects.1.values.sag" = ["0.02 mrad"]\n'
    text += '"workshop.shadow_cone_deg" = ["none", 70]\n'
    _, scenarios, factors, levels = made(tmp_path, text)
    assert [(f.name, f.unit) for f in factors] == [
        ("beam-tilt", "urad"), ("sag", "urad"), ("shadow_cone_deg", "deg"),
    ]  # fmt: skip
    assert levels[0]["beam-tilt"] == pytest.approx(4.848136811)
    assert scenarios[0].effects[0].values["sag"] == pytest.approx(20.0)
    assert [x["shadow_cone_deg"] for x in levels] == [None, 70.0]
    words = "beam-tilt = 4.84814 urad, sag = 20 urad, shadow_cone_deg = "
    assert [cell_label(factors, x) for x in levels] == [words + "none", words + "70"]


@pytest.mark.parametrize("kind", ["sobol", "latin-hypercube"])
def test_designs_fill_their_ranges_and_come_from_the_seed(kind: str, tmp_path: Path) -> None:
    text = f'[design]\nkind = "{kind}"\ncell_count = 16\n[design.ranges."work.targets"]\nlow = 3\nhigh = 6\n'
    text += '[design.ranges."instrument.noise_factor"]\nlow = 0.1\nhigh = 10\nscale = "log"\n'
    _, _, _, levels = made(tmp_path, text)
    assert levels == made(tmp_path, text)[3] != made(tmp_path, "seed = 2\n" + text)[3]
    counts = np.bincount([x["targets"] for x in levels])
    assert counts.tolist() == [0, 0, 0, 4, 4, 4, 4]
    slices = np.floor(8 * np.log10([x["noise_factor"] for x in levels])) + 8
    assert np.bincount(slices.astype(int)).tolist() == [1] * 16


def test_a_preset_is_swept_with_all_it_stands_for(tmp_path: Path) -> None:
    text = '[grid]\n"instrument.noise.azimuth_arcsec" = [0.3]\n"instrument.preset" = ["paper", "modern"]\n'
    _, scenarios, _, _ = made(tmp_path, text)
    noise_values = [(s.instrument.noise.azimuth_arcsec, s.instrument.noise.elevation_arcsec) for s in scenarios]
    assert noise_values == [(0.3, 0.37), (0.3, 0.2)]
    assert [s.instrument.prior.offset_mm for s in scenarios] == [0.014, 0.005]


def test_whole_numbers_of_a_range_are_equally_likely() -> None:
    shares = (np.arange(1000) + 0.5) / 1000
    values = ScenarioKeyRange(low=1, high=4).values_at(shares, is_integer=True)
    assert np.bincount(values).tolist() == [0, 250, 250, 250, 250]


def test_names_are_as_short_as_distinct_names_can_be() -> None:
    keys = ["instruments.A.noise_factor", "instruments.B.noise_factor", "work.faces", "x.trial"]
    assert list(short_key_names(keys).values()) == ["A_noise_factor", "B_noise_factor", "faces", "x_trial"]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[grid]\n"instrument.noise.azimuth_arcsec" = ["0.5 mm"]\n', "azimuth_arcsec is '0.5 mm', expected a number"),
        ('[grid]\n"instrument.noise.azimuth" = [0.5]\n', "did you mean azimuth_arcsec"),
        ('[grid]\n"work.stations" = [6]\n', "work.stations is 6, but the scenario has 5"),
        ('[grid]\n"work.targets" = [0]\ngauge = ["none"]\n', "work.targets is 0, expected at least 3"),
        ('[grid]\n"effects.3.values.x" = [1]\n', "contains the part 3, which is not a table"),
        ('[design]\nkind = "sobol"\ncell_count = 50\n' + RANGE + "low = 3\nhigh = 6\n", "such as 64"),
        ('[design]\nkind = "sobol"\ncell_count = 8\n' + RANGE + "low = 6\nhigh = 3\n", "low should be below high"),
        (LINK + '[grid]\nnoise_arcsec = [1]\n"instrument.noise.azimuth_arcsec" = [1]\n', "vary each key once"),
        ('[stop]\nmax_half_width = 0\n', "greater than 0"),
        ('statistics = ["errors"]\n[stop]\nmax_half_width = 1\nstatistic = "z:beam-tilt"\n', "include 'z-scores'"),
    ],
)  # fmt: skip
def test_a_factor_that_cannot_be_varied_is_refused_in_a_sentence(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as raised:
        made(tmp_path, text)
    assert says in str(raised.value) and "\n" not in str(raised.value)
