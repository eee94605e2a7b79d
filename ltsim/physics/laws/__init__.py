"""The language in which physics is told: a carrier that follows a driver at a place. It knows of no search."""
