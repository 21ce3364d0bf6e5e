"""Stable Fiber-Koopman Residual Dynamics, the project's own model.

`_model.py` has its equations, `_residual.py` the kinds of residual and the bound that
it shares with the operators, `_learned.py` everything learned.
"""

from sfkd_jax.models.sfkd._model import sfkd as sfkd
from sfkd_jax.models.sfkd._residual import RESIDUALS as RESIDUALS
