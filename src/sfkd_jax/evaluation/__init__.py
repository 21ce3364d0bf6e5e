"""Closed-loop and open-loop evaluation: episodes, scores and their statistics."""

from sfkd_jax.evaluation._loops import Episode as Episode
from sfkd_jax.evaluation._loops import disturbed_environment as disturbed_environment
from sfkd_jax.evaluation._loops import observed_environment as observed_environment
from sfkd_jax.evaluation._loops import simulate as simulate
from sfkd_jax.evaluation._open_loop import open_loop as open_loop
from sfkd_jax.evaluation._rows import SHARED as SHARED
from sfkd_jax.evaluation._rows import Scores as Scores
from sfkd_jax.evaluation._rows import compare as compare
from sfkd_jax.evaluation._rows import disturbed as disturbed
from sfkd_jax.evaluation._rows import identity as identity
from sfkd_jax.evaluation._rows import merge as merge
from sfkd_jax.evaluation._rows import pool as pool
from sfkd_jax.evaluation._rows import row as row
from sfkd_jax.evaluation._rows import score as score
from sfkd_jax.evaluation._statistics import holm as holm
from sfkd_jax.evaluation._statistics import mean_interval as mean_interval
from sfkd_jax.evaluation._statistics import p_value as p_value
from sfkd_jax.evaluation._statistics import paired_difference as paired_difference
from sfkd_jax.evaluation._statistics import summary as summary
