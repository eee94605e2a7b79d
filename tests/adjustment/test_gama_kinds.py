"""Networks of the kinds that gama-local adjusts, in its format, against an adjustment in plain numpy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from ltsim.adjustment import adjust
from ltsim.adjustment.quality import pose_curvatures
from ltsim.core.errors import NetworkError, RecordError
from ltsim.core.randomness import random_stream
from ltsim.recordings import read

PRINTED = 5e-6
"""[m] Half of the last digit that gama-local prints."""
CC, GON, MM = np.pi / 2e6, np.pi / 200, 1e-3
KINDS = {"direction": (5 * CC, GON), "angle": (7 * CC, GON), "z-angle": (8 * CC, GON)}
KINDS |= {"azimuth": (6 * CC, GON), "distance": (2 * MM, 1.0), "s-distance": (2 * MM, 1.0)}
"""Standard deviation, and the unit of the value in the file."""
PLACES = {
    "A": (0.0, 0.0, 0.0),
    "B": (120.0, 15.0, 4.0),
    "C": (90.0, 110.0, -6.0),
    "D": (-20.0, 95.0, 2.0),
    "E": (45.0, 60.0, 9.0),
    "F": (200.0, 70.0, 3.0),
    "SPIRE": (60.0, -80.0, 40.0),
}


@dataclass(frozen=True)
class Sight:
    """One observation; `back` is the other end of an angle, heights stand over the marks [m]."""

    kind: str
    start: str
    end: str
    back: str = ""
    heights: tuple[float, float] = (0.0, 0.0)
    value: float = 0.0

    def of(self, places: dict[str, np.ndarray]) -> float:
        """Its value [rad, m]; that of a direction without its orientation."""
        x, y, z = places[self.end] - places[self.start]
        z, flat = z + self.heights[1] - self.heights[0], np.hypot(x, y)
        if self.kind == "angle":
            u, v, _ = places[self.back] - places[self.start]
            return float(np.arctan2(v, u) - np.arctan2(y, x))
        values = {
            "direction": -np.arctan2(y, x),
            "azimuth": np.pi / 2 - np.arctan2(y, x),
            "z-angle": np.arctan2(flat, z),
            "distance": flat,
        }
        return float(values.get(self.kind, np.hypot(flat, z)))


def sights(kinds: str, ways: str, heights: tuple[float, float] = (0.0, 0.0)) -> list[Sight]:
    """Such as ``AB BA`` seen by all kinds, set by set."""
    return [Sight(kind, way[0], way[1:], heights=heights) for way in ways.split() for kind in kinds.split()]


@dataclass(frozen=True)
class Network:
    """Points as their attributes in the file, what is observed, and the unknown coordinates as ``Ax Ay``."""

    points: dict[str, str]
    observed: list[Sight]
    unknown: str

    @property
    def sets(self) -> list[str]:
        """Points with an orientation of their own."""
        return list(dict.fromkeys(s.start for s in self.observed if s.kind == "direction"))

    def measured(self, seed: int) -> Network:
        """The network with noisy values, in the digits of the file."""
        rng, noisy = random_stream(seed, "gama-kinds"), []
        turns = {name: rng.uniform(0, 6) for name in self.sets}
        places = {name: np.array(place) for name, place in PLACES.items()}
        for s in self.observed:
            sigma, unit = KINDS[s.kind]
            value = s.of(places) - turns.get(s.start, 0.0) * (s.kind == "direction") + sigma * rng.standard_normal()
            noisy.append(replace(s, value=round(value / unit % (400 if unit == GON else 1e9), 7)))
        return replace(self, observed=noisy)

    def write(self, path: Path) -> Path:
        """The file of gama-local."""
        points = [f'<point id="{name}" {description}/>' for name, description in self.points.items()]
        for start in dict.fromkeys(s.start for s in self.observed):
            points.append(f'<obs from="{start}">')
            for s in (s for s in self.observed if s.start == start):
                ends = f'bs="{s.back}" fs="{s.end}"' if s.back else f'to="{s.end}"'
                stdev = KINDS[s.kind][0] / (CC if KINDS[s.kind][1] == GON else MM)
                high = f'from_dh="{s.heights[0]}" to_dh="{s.heights[1]}"' if any(s.heights) else ""
                points.append(f'<{s.kind} {ends} val="{s.value}" stdev="{stdev:.6f}" {high}/>')
            points.append("</obs>")
        head = '<?xml version="1.0"?><gama-local><network axes-xy="en"><parameters sigma-apr="1"/>'
        inside = "\n".join(points)
        path.write_text(f"{head}<points-observations>{inside}</points-observations></network></gama-local>")
        return path

    def solve(self) -> tuple[np.ndarray, np.ndarray, float, int]:
        """Unknown coordinates and their standard deviations [m], the sum of squares, the degrees of freedom.

        Each step has the least norm that minimises: a free network stays on its approximate coordinates.
        """
        unknown = [(word[:-1], "xyz".index(word[-1])) for word in self.unknown.split()]
        sigma, unit = np.array([KINDS[s.kind] for s in self.observed]).T
        value = np.array([s.value for s in self.observed]) * unit
        is_of_set = np.array(
            [[s.kind == "direction" and s.start == group for group in self.sets] for s in self.observed]
        )
        is_of_set = is_of_set.reshape(len(value), -1) / sigma[:, None]

        def residual(x: np.ndarray) -> np.ndarray:
            """With the orientation of each set at its mean."""
            places = {name: np.array(place) for name, place in PLACES.items()}
            for (name, axis), number in zip(unknown, x, strict=True):
                places[name][axis] = number
            gap = value - np.array([s.of(places) for s in self.observed])
            for member in (is_of_set > 0).T:
                gap[member] -= np.angle(np.exp(1j * gap[member]).sum())
            gap = np.where(unit == GON, (gap + np.pi) % (2 * np.pi) - np.pi, gap) / sigma
            return np.asarray(gap - is_of_set @ np.linalg.lstsq(is_of_set, gap, rcond=None)[0])

        x = np.array([PLACES[name][axis] for name, axis in unknown])
        for _ in range(8):
            steps = 1e-4 * np.eye(len(x))
            design = np.array([(residual(x - h) - residual(x + h)) / 2e-4 for h in steps]).T
            x = x + np.linalg.lstsq(design, residual(x), rcond=1e-8)[0]
        rank, rest = np.linalg.matrix_rank(design, tol=1e-8 * np.linalg.norm(design, 2)), residual(x)
        spread = np.sqrt(np.diag(np.linalg.pinv(design.T @ design, rcond=1e-12)))
        return x, spread, float(rest @ rest), len(value) - int(rank) - is_of_set.shape[1]


def placed(names: str, attributes: str) -> dict[str, str]:
    """Points with their coordinates in the file."""
    return {
        n: " ".join(f'{a}="{v}"' for a, v in zip("xyz", PLACES[n], strict=True)) + f" {attributes}"
        for n in names.split()
    }


PLAN = sights("direction distance", "AB AC AD AE BA BC BE CA CD CE DA DE EA EB EC")
TRAVERSE = [
    *(Sight("angle", at, on, back) for back, at, on in ("DAE", "AEC", "ECF", "CFB", "FBA")),
    *sights("distance", "AE EC CF FB"),
]
CHAIN = sights("direction z-angle s-distance", "AE EA EC CE CF FC FB BF BA AB", heights=(1.6, 1.4))
SPACE = sights("direction z-angle s-distance", "AB AC AE BA BC BE CA CB CE EA EB EC")
NETWORKS = {
    "free in plan": Network(placed("A B C D E", 'adj="XY"'), PLAN, "Ax Ay Bx By Cx Cy Dx Dy Ex Ey"),
    "fixed in plan": Network(placed("A B", 'fix="xy"') | dict.fromkeys("CDE", 'adj="xy"'), PLAN, "Cx Cy Dx Dy Ex Ey"),
    "one point and azimuths in plan": Network(
        placed("A", 'fix="xy"') | dict.fromkeys("BCDEF", 'adj="xy"'),
        [*PLAN, *sights("azimuth", "AB CE DF"), *sights("distance", "AF")],
        "Bx By Cx Cy Dx Dy Ex Ey Fx Fy",
    ),
    "one point and an azimuth in space": Network(
        placed("A", 'fix="xyz"') | dict.fromkeys("BCE", 'adj="xyz"'),
        [*SPACE, *sights("azimuth", "CA")],
        "Bx By Bz Cx Cy Cz Ex Ey Ez",
    ),
    "traverse of angles": Network(
        placed("A B D", 'fix="xy"') | dict.fromkeys("ECF", 'adj="xy"'), TRAVERSE, "Ex Ey Cx Cy Fx Fy"
    ),
    "traverse in space": Network(
        placed("A B", 'fix="xyz"') | dict.fromkeys("ECF", 'adj="xyz"'), CHAIN, "Ex Ey Ez Cx Cy Cz Fx Fy Fz"
    ),
    "heights of some": Network(
        placed("A", 'fix="xyz"') | placed("B", 'fix="xy" adj="z"') | dict.fromkeys(("C", "E", "SPIRE"), 'adj="xyz"'),
        [*SPACE, *sights("direction", "ASPIRE BSPIRE ESPIRE")],
        "Bz Cx Cy Cz Ex Ey Ez SPIREx SPIREy",
    ),
    "plan of two, height of another": Network(
        placed("A B", 'fix="xy" adj="z"') | placed("C", 'fix="z" adj="xy"') | {"E": 'adj="xyz"'},
        SPACE,
        "Az Bz Cx Cy Ex Ey Ez",
    ),
    "distances alone in plan": Network(
        placed("A B D", 'fix="xy"') | {"C": 'x="95" y="100" adj="xy"', "E": 'x="50" y="70" adj="xy"'},
        sights("distance", "AC BC DE AE CE"),
        "Cx Cy Ex Ey",
    ),
    "distances alone in space": Network(
        placed("A B C D", 'fix="xyz"') | {"E": 'x="50" y="65" z="20" adj="xyz"'},
        sights("s-distance", "AE BE CE DE"),
        "Ex Ey Ez",
    ),
    "angles at one point": Network(
        placed("A B C D", 'fix="xy"') | {"E": 'x="50" y="65" adj="xy"'},
        [*(Sight("angle", "E", on, back) for back, on in ("AB", "BC", "CD")), *sights("distance", "AE")],
        "Ex Ey",
    ),
    "plan beside space": Network(
        placed("A B", 'fix="xyz"') | dict.fromkeys("CE", 'adj="xyz"') | {"D": 'adj="xy"'},
        [*SPACE, *sights("direction distance", "AD DA DE ED DC")],
        "Cx Cy Cz Dx Dy Ex Ey Ez",
    ),
}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("kind", NETWORKS)
def test_a_network_agrees_with_plain_numpy_beyond_the_digit_that_gama_prints(
    tmp_path: Path, kind: str, seed: int
) -> None:
    network = NETWORKS[kind].measured(seed)
    x, spread, square_sum, dof = network.solve()
    adjustment = adjust(read(network.write(tmp_path / "network.gkf")))
    names = adjustment.recording.targets
    at = [(names.index(word[:-1]), "xyz".index(word[-1])) for word in network.unknown.split()]
    assert adjustment.dof == dof
    assert adjustment.chi2 == pytest.approx(square_sum, rel=1e-6)
    ours, sigma = adjustment.state.target_points, np.sqrt(adjustment.target_covariances[:, range(3), range(3)])
    assert np.abs([ours[i] for i in at] - x).max() < PRINTED / 5
    np.testing.assert_allclose([sigma[i] for i in at], spread, rtol=1e-3)
    height_names = {word[:-1] for word in network.unknown.split() if word[-1] == "z"}
    open_ = {names[t] for t in np.flatnonzero(adjustment.is_height_undetermined_target)}
    fixed = {
        name for name, description in network.points.items() if "adj" not in description or 'fix="z"' in description
    }
    assert set(network.points) - fixed - open_ == height_names


def test_a_point_with_only_a_distance_is_excluded_and_an_undetermined_rotation_has_no_curvature(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where azimuths are left out: neither a search without end nor an eigenvector of what is unknown."""
    points = placed("A", 'fix="xy"') | dict.fromkeys("BCDEF", 'adj="xy"')
    network = Network(points, [*PLAN, *sights("distance", "AF")], "Bx By Cx Cy Dx Dy Ex Ey").measured(0)
    adjustment = adjust(read(network.write(tmp_path / "network.gkf")))
    assert adjustment.solution.has_converged
    assert adjustment.undetermined_targets == ("F",)
    assert adjustment.dof == network.solve()[3] - 1
    spread = adjustment.pose_covariance.copy()
    spread[1, :3, 3:], spread[1, 5, 5] = np.nan, 1.0
    monkeypatch.setattr(type(adjustment), "pose_covariance", spread)
    assert np.array_equal(np.isnan(pose_curvatures(adjustment)), np.isnan(spread).any(axis=(1, 2)))


def test_a_network_of_directions_alone_has_no_scale(tmp_path: Path) -> None:
    points = placed("A B C D E", 'adj="xy"')
    network = Network(points, sights("direction", "AB AC AD BA BC BD CA CB CE DA DB EC EA"), "").measured(0)
    with pytest.raises(NetworkError, match="no distance, known length or two known points"):
        adjust(read(network.write(tmp_path / "network.gkf"))).require_solution()


def test_a_file_of_levelling_alone_says_what_it_holds(tmp_path: Path) -> None:
    levelled = '<height-differences><dh from="A" to="B" val="1.5" stdev="1"/></height-differences>'
    inside = f"<network><points-observations>{levelled}</points-observations></network>"
    (tmp_path / "levelling.gkf").write_text(f"<gama-local>{inside}</gama-local>")
    with pytest.raises(RecordError, match="contains height differences or vectors without pointings"):
        read(tmp_path / "levelling.gkf")


def test_a_far_point_is_fixed_by_angles_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At kilometres a direction tells centimetres and a fixed coordinate micrometres: both are known."""
    for name, place in PLACES.items():
        monkeypatch.setitem(PLACES, name, [40.0 * x for x in place])
    sights = [Sight("angle", at, "E", back) for back, at in ("BA", "AB", "DB", "BD")]
    network = Network(placed("A B D", 'fix="xy"') | {"E": 'adj="xy"'}, sights, "Ex Ey").measured(0)
    adjustment, (x, _, square_sum, dof) = adjust(read(network.write(tmp_path / "network.gkf"))), network.solve()
    assert not adjustment.undetermined_targets
    assert adjustment.dof == dof == 2
    assert adjustment.chi2 == pytest.approx(square_sum, rel=1e-6)
    assert np.abs(adjustment.state.target_points[adjustment.recording.targets.index("E"), :2] - x).max() < PRINTED
