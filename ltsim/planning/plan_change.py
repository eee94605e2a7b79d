"""Change of one reflector in plan.json, and units of places and angles in result files."""

from typing import Literal

from ltsim.core.arrays import Floats
from ltsim.core.units import DEGREE, MILLIMETRE
from ltsim.recordings.result_file import Entry, Finite, Vector


def to_millimetres(point: Floats, decimals: int = 1) -> Vector:
    """Place (3,) [m] converted to millimetres for a result file."""
    x, y, z = (round(float(v) / MILLIMETRE, decimals) for v in point)
    return x, y, z


def to_degrees(angle: float) -> float:
    """Angle [rad] converted to degrees (0 to 360) for a result file."""
    return round(float(angle) / DEGREE % 360, 2)


class PlanChange(Entry):
    """Change of one reflector of a plan: moved, added or removed."""

    do: Literal["move", "add", "remove"]
    """Type of the change."""
    words: str = ""
    """Change and its benefit, as a sentence."""
    reflector: str = ""
    """Name of the reflector that is moved or removed."""
    place: str = ""
    """Name of the new place."""
    position_mm: Vector | None = None
    """Coordinates of the new place."""
    gain_um: Finite
    """Decrease of the point error of all other targets (weighted root mean square, inner constraints);
    negative for an increase.
    """
    quality: Finite
    """Factor on the plan's objective, or, if only targets have a weight, on the error of all other targets; smaller is
    better.
    """
    serves: str = ""
    """Parameter or target whose standard deviation falls most, or rises most if a reflector is removed."""
    serves_factor: Finite = 1.0
    """Factor on the standard deviation of that parameter or target; below 1 is better."""

    @property
    def action_text(self) -> str:
        """Text of the change, with the place in metres."""
        if self.position_mm is None:
            return f"leave out {self.reflector}"
        place = f"{self.place} ({', '.join(f'{v / 1000:.2f}' for v in self.position_mm)}) m"
        return f"move {self.reflector} to {place}" if self.reflector else f"add a reflector at {place}"
