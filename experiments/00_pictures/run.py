"""The picture of the README: the paper's workshop with its shadow cones, drawn from the scenario alone."""

import ltsim as lt
from experiments.common import Made, Options


def run(given: Options) -> Made:
    """Draw it into `results/readme`."""
    folder = given.out.parent / "readme"
    folder.mkdir(parents=True, exist_ok=True)
    lt.view("paper-workshop").png(folder / "workshop.png")
    return Made(folder=folder)
