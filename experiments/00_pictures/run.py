"""Picture of the README: the paper's workshop with its shadow cones, drawn from the scenario alone."""

from PIL import Image

import ltsim as lt
from experiments.common import Made, Options

COLOURS = 128
"""Number of colours of the picture: two fifths of the size, and no difference that is seen."""


def run(given: Options) -> Made:
    """Draw it into `results/readme`."""
    folder = given.out.parent / "readme"
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "workshop.png"
    lt.view("paper-workshop").write_png(file)
    with Image.open(file) as picture:
        picture.quantize(COLOURS).save(file, optimize=True)
    return Made(folder=folder)
