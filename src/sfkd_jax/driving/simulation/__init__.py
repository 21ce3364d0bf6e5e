"""Episodes in closed loop, their metrics, and rows of tables."""

from sfkd_jax.driving.simulation._control_step import ClosedLoop as ClosedLoop
from sfkd_jax.driving.simulation._control_step import LoopState as LoopState
from sfkd_jax.driving.simulation._control_step import StepOutcome as StepOutcome
from sfkd_jax.driving.simulation._control_step import Surroundings as Surroundings
from sfkd_jax.driving.simulation._loops import Episode as Episode
from sfkd_jax.driving.simulation._loops import (
    disturbed_environment as disturbed_environment,
)
from sfkd_jax.driving.simulation._loops import (
    observed_environment as observed_environment,
)
from sfkd_jax.driving.simulation._loops import simulate as simulate
from sfkd_jax.driving.simulation._rows import SHARED as SHARED
from sfkd_jax.driving.simulation._rows import Scores as Scores
from sfkd_jax.driving.simulation._rows import compare as compare
from sfkd_jax.driving.simulation._rows import disturbed as disturbed
from sfkd_jax.driving.simulation._rows import identity as identity
from sfkd_jax.driving.simulation._rows import merge as merge
from sfkd_jax.driving.simulation._rows import pool as pool
from sfkd_jax.driving.simulation._rows import row as row
from sfkd_jax.driving.simulation._rows import score as score
