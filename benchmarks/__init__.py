"""Benchmarks: run one with `python -m benchmarks.<group>.<name>` from the repository."""
