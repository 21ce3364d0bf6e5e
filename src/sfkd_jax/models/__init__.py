"""Belief: every file one factory that returns a `Model`; `FACTORIES` is the registry by name."""

from sfkd_jax.models._physics import physics as physics
from sfkd_jax.models.sfkd import sfkd as sfkd

FACTORIES = {"sfkd": sfkd}
"""Learned models: name -> factory(space, *, settings)."""
