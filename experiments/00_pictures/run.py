"""Picture of the README: the paper's workshop with its shadow cones, drawn from the scenario alone."""

from PIL import Image

import ltsim as lt
from experiments.common import Options, RunRecord

COLOURS = 128
"""Number of colours of the picture, which reduces the file to two fifths without a visible difference."""


def run(options: Options) -> RunRecord:
    """Draw the picture, and write it to `results/readme`."""
    folder = options.out.parent / "readme"
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "workshop.png"
    lt.view("paper-workshop").write_png(file)
    with Image.open(file) as picture:
        picture.quantize(COLOURS).save(file, optimize=True)
    return RunRecord(folder=folder)
