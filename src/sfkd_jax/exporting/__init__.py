"""Controllers for other processes: as StableHLO that jax alone runs, as IREE modules for C and C++, compiled ahead."""

from sfkd_jax.exporting._folder import PLATFORMS as PLATFORMS
from sfkd_jax.exporting._folder import write_controller as write_controller
from sfkd_jax.exporting._programs import Leaf as Leaf
from sfkd_jax.exporting._programs import Program as Program
from sfkd_jax.exporting._programs import Programs as Programs
from sfkd_jax.exporting._programs import flat_programs as flat_programs
from sfkd_jax.exporting._warm_up import warm_up as warm_up
from sfkd_jax.exporting._weights_first import weights_first as weights_first
