"""Stable Fiber-Koopman Residual Dynamics, the project's own model.

`_model.py` has its equations and settings, `_latent_model.py` its functions,
`_residual.py` the residuals and the bound that they share with the operators, and
`_learned.py` everything that is learned.
"""

from sfkd_jax.models.sfkd._model import sfkd as sfkd
from sfkd_jax.models.sfkd._residual import RESIDUALS as RESIDUALS
