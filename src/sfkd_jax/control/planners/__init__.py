"""Sampling, gradient and quadratic-program planners."""
