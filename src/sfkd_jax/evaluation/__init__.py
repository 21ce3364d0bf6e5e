"""The test track: closed loop, open loop, metrics and their statistics."""

from sfkd_jax.evaluation._closed_loop import Episode as Episode
from sfkd_jax.evaluation._closed_loop import first_reference as first_reference
from sfkd_jax.evaluation._closed_loop import simulate as simulate
from sfkd_jax.evaluation._metrics import Scores as Scores
from sfkd_jax.evaluation._metrics import score as score
from sfkd_jax.evaluation._open_loop import open_loop as open_loop
from sfkd_jax.evaluation._rows import compare as compare
from sfkd_jax.evaluation._rows import merge as merge
from sfkd_jax.evaluation._rows import row as row
from sfkd_jax.evaluation._statistics import bootstrap_mean as bootstrap_mean
from sfkd_jax.evaluation._statistics import paired_difference as paired_difference
from sfkd_jax.evaluation._statistics import summary as summary
