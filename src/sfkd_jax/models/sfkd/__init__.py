"""Stable Fiber-Koopman Residual Dynamics, the project's own model."""

from sfkd_jax.models.sfkd._bounds import bounded as bounded
from sfkd_jax.models.sfkd._bounds import gram_bound as gram_bound
from sfkd_jax.models.sfkd._budget import share_budget as share_budget
from sfkd_jax.models.sfkd._model import sfkd as sfkd
from sfkd_jax.models.sfkd._records import SfkdFiber as SfkdFiber
from sfkd_jax.models.sfkd._records import SfkdLatent as SfkdLatent
from sfkd_jax.models.sfkd._sandwich import Sandwich as Sandwich
from sfkd_jax.models.sfkd._sandwich import cayley as cayley
from sfkd_jax.models.sfkd._transport import rotate_planes as rotate_planes
