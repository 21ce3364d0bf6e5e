"""Export controllers as StableHLO for jax and as IREE modules for C and C++."""

from sfkd_jax.exporting._constants import fold_constants as fold_constants
from sfkd_jax.exporting._folder import PLATFORMS as PLATFORMS
from sfkd_jax.exporting._folder import write_controller as write_controller
from sfkd_jax.exporting._programs import Leaf as Leaf
from sfkd_jax.exporting._programs import Program as Program
from sfkd_jax.exporting._programs import Programs as Programs
from sfkd_jax.exporting._programs import flat_programs as flat_programs
from sfkd_jax.exporting._warm_up import warm_up as warm_up
