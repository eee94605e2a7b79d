"""Each a function from data to a matplotlib Figure."""
