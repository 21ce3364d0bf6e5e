"""Export controllers as StableHLO for jax and as IREE modules for C and C++."""

from sfkd_jax.export._controller import write_controller as write_controller
from sfkd_jax.export._programs import flat_programs as flat_programs
from sfkd_jax.export._programs import warm_up as warm_up
