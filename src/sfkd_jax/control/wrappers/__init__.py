"""Controllers around a controller: monitor, estimator, adaptation, delay, shield."""
