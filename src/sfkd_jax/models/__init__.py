"""Models; those that are learned are listed in `FACTORIES`."""

from sfkd_jax.models._continuous import neural_ode as neural_ode
from sfkd_jax.models._control_synth import control_synth as control_synth
from sfkd_jax.models._icode import icode as icode
from sfkd_jax.models._icode import icode_mppi as icode_mppi
from sfkd_jax.models._one_step import one_step as one_step
from sfkd_jax.models._own import own as own
from sfkd_jax.models._state_model import flat as flat
from sfkd_jax.models._state_model import nested as nested
from sfkd_jax.models._state_model import physics as physics
from sfkd_jax.models._state_model import state_model as state_model
from sfkd_jax.models._state_model import step_of as step_of
from sfkd_jax.models.sfkd import sfkd as sfkd

FACTORIES = {
    "sfkd": sfkd,
    "neural_ode": neural_ode,
    "icode": icode,
    "icode_mppi": icode_mppi,
    "control_synth": control_synth,
}
"""Learned models: name -> factory(space, *, settings).

`space` holds measured scales, which fix all sizes. Several models have these settings:
`dt` is the sampling period and the solver's step [s]. `environment` is whether e is
used; if not, e is 0. `frame` is a `types.Frame`, the coordinates of states.
"""
