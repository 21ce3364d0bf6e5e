"""Decision: planners over any rollout model. Imports jax only; takes models and costs as arguments."""

from sfkd_jax.control._box_qp import BoxSolution as BoxSolution
from sfkd_jax.control._box_qp import box_qp as box_qp
from sfkd_jax.control._costs import Stage as Stage
from sfkd_jax.control._costs import StageCost as StageCost
from sfkd_jax.control._costs import tracking_cost as tracking_cost
from sfkd_jax.control._koopman_mpc import KoopmanMpcState as KoopmanMpcState
from sfkd_jax.control._koopman_mpc import koopman_mpc as koopman_mpc
from sfkd_jax.control._monitor import MonitorState as MonitorState
from sfkd_jax.control._monitor import monitored as monitored
from sfkd_jax.control._mppi import PlannerState as PlannerState
from sfkd_jax.control._mppi import mppi as mppi
from sfkd_jax.control._noise import correlated_noise as correlated_noise
from sfkd_jax.control._path_frame import Law as Law
from sfkd_jax.control._path_frame import PathErrors as PathErrors
from sfkd_jax.control._path_frame import no_feedback as no_feedback
from sfkd_jax.control._path_frame import path_errors as path_errors
from sfkd_jax.control._path_frame import path_feedback as path_feedback
from sfkd_jax.control._path_frame import reference_curvature as reference_curvature
from sfkd_jax.control._smoothing import plan_smoother as plan_smoother
from sfkd_jax.control._smoothing import savitzky_golay_weights as savitzky_golay_weights
