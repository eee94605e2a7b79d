"""What every package uses: errors, units, randomness, text, results, storage, limits, processes."""
