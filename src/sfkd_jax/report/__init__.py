"""Pages, tables, figures and films of runs: reads their files, computes nothing.

Nothing is imported here: `python -m sfkd_jax.report` imports this package first, and
without the extra `train` it must come as far as the hint of `experiment`.
"""
