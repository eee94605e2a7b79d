"""What a measurement is worth: tasks on adjusted points, their uncertainty by the GUM and by Monte Carlo, verdicts."""
