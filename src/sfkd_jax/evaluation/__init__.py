"""Errors in open loop, statistics, and formats of numbers."""

from sfkd_jax.evaluation._open_loop import open_loop as open_loop
from sfkd_jax.evaluation._statistics import holm as holm
from sfkd_jax.evaluation._statistics import mean_interval as mean_interval
from sfkd_jax.evaluation._statistics import p_value as p_value
from sfkd_jax.evaluation._statistics import paired_difference as paired_difference
from sfkd_jax.evaluation._statistics import summary as summary
