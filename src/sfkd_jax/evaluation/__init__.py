"""The test track: closed loop, open loop, metrics and their statistics."""

from sfkd_jax.evaluation._closed_loop import Episode as Episode
from sfkd_jax.evaluation._closed_loop import first_reference as first_reference
from sfkd_jax.evaluation._closed_loop import pushed as pushed
from sfkd_jax.evaluation._closed_loop import simulate as simulate
from sfkd_jax.evaluation._metrics import Scores as Scores
from sfkd_jax.evaluation._metrics import score as score
from sfkd_jax.evaluation._open_loop import open_loop as open_loop
from sfkd_jax.evaluation._rows import compare as compare
from sfkd_jax.evaluation._rows import disturbed as disturbed
from sfkd_jax.evaluation._rows import pool as pool
from sfkd_jax.evaluation._rows import row as row
from sfkd_jax.evaluation._statistics import bootstrap_mean as bootstrap_mean
from sfkd_jax.evaluation._statistics import paired_difference as paired_difference
from sfkd_jax.evaluation._statistics import summary as summary
from sfkd_jax.evaluation._told import told as told
from sfkd_jax.evaluation._violations import STRIDE as STRIDE
from sfkd_jax.evaluation._violations import Claims as Claims
from sfkd_jax.evaluation._violations import Predictions as Predictions
from sfkd_jax.evaluation._violations import predictions as predictions
from sfkd_jax.evaluation._violations import theorem_reach as theorem_reach
from sfkd_jax.evaluation._violations import theorem_violations as theorem_violations
from sfkd_jax.evaluation._violations import threshold_violations as threshold_violations
from sfkd_jax.evaluation._violations import tube_violations as tube_violations
from sfkd_jax.evaluation._violations import violations as violations
