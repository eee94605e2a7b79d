"""Pure geometry: rotations, polar coordinates, closed-form alignment. Knows nothing of trackers."""
