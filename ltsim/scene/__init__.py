"""Scene geometry: places, bodies, and visibility between instruments and targets."""
