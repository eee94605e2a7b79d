"""Kinds of instruments whose noise and guarantees hold where a file states none."""

from ltsim.recordings.setup import Instrument, Noise

TOTAL_STATION_NOISE = Noise(distance_mm=1.0, distance_ppm=1.5, azimuth_arcsec=1.0, elevation_arcsec=1.0)
"""Standard deviations of a total station of the first class by ISO 17123, as makers' data sheets state them."""
TOTAL_STATION = Instrument(noise=TOTAL_STATION_NOISE, corrected=True)
"""A total station: its own corrections are in the readings."""
NO_NOISE = (
    "the file states no noise: that of the default laser tracker is taken (3 um + 0.3 ppm, 0.37 arcsec); edit "
    "setup.toml to state it, or let the readings say (--noise-from-data)"
)
LIKE_TOTAL_STATION = (
    "the file states no noise: that of a total station is taken (1 mm + 1.5 ppm, 1 arcsec), because {reason}; edit "
    "setup.toml to state it, or let the readings say (--noise-from-data)"
)
