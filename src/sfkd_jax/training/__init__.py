"""Training of any `Model`: losses, the optimiser loop, logs and checkpoints."""

from sfkd_jax.training._checkpoints import Checkpoints as Checkpoints
from sfkd_jax.training._loop import Callback as Callback
from sfkd_jax.training._loop import TrainingStopped as TrainingStopped
from sfkd_jax.training._loop import descend as descend
from sfkd_jax.training._loop import fit as fit
from sfkd_jax.training._loop import no_callback as no_callback
from sfkd_jax.training._losses import Loss as Loss
from sfkd_jax.training._losses import multi_step_loss as multi_step_loss
from sfkd_jax.training._losses import one_step_loss as one_step_loss
from sfkd_jax.training._losses import planning_loss as planning_loss
