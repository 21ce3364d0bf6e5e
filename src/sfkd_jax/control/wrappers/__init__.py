"""Controllers around a controller: monitor, estimator, delay compensation, shield."""
