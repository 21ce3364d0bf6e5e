"""Controllers: tasks, planners, feedback laws and wrappers, for any dynamics."""

from sfkd_jax.control.laws._model_law import ModelLaw as ModelLaw
from sfkd_jax.control.laws._model_law import SteadyTurn as SteadyTurn
from sfkd_jax.control.laws._path_errors import FeedbackLaw as FeedbackLaw
from sfkd_jax.control.laws._path_errors import PathErrors as PathErrors
from sfkd_jax.control.laws._path_errors import no_feedback as no_feedback
from sfkd_jax.control.laws._path_errors import path_errors as path_errors
from sfkd_jax.control.laws._path_errors import path_feedback as path_feedback
from sfkd_jax.control.laws._path_errors import (
    reference_curvature as reference_curvature,
)
from sfkd_jax.control.laws._path_law import PathLaw as PathLaw
from sfkd_jax.control.laws._path_law import derive_path_law as derive_path_law
from sfkd_jax.control.laws._path_law import law_from_arrays as law_from_arrays
from sfkd_jax.control.laws._path_law import law_to_arrays as law_to_arrays
from sfkd_jax.control.laws._path_law import turn_control as turn_control
from sfkd_jax.control.planners._autotune import Autotuned as Autotuned
from sfkd_jax.control.planners._autotune import autotune as autotune
from sfkd_jax.control.planners._box_qp import BoxSolution as BoxSolution
from sfkd_jax.control.planners._box_qp import box_qp as box_qp
from sfkd_jax.control.planners._cem import cem as cem
from sfkd_jax.control.planners._gains import between_plans as between_plans
from sfkd_jax.control.planners._gradient import gradient_planner as gradient_planner
from sfkd_jax.control.planners._koopman_mpc import KoopmanMpcState as KoopmanMpcState
from sfkd_jax.control.planners._koopman_mpc import koopman_mpc as koopman_mpc
from sfkd_jax.control.planners._mppi import mppi as mppi
from sfkd_jax.control.planners._noise import NoiseSampler as NoiseSampler
from sfkd_jax.control.planners._noise import correlated_noise as correlated_noise
from sfkd_jax.control.planners._noise import noise_sampler as noise_sampler
from sfkd_jax.control.planners._planner import planner as planner
from sfkd_jax.control.planners._plans import PlannerState as PlannerState
from sfkd_jax.control.planners._plans import Search as Search
from sfkd_jax.control.planners._plans import SearchResult as SearchResult
from sfkd_jax.control.planners._plans import Tuning as Tuning
from sfkd_jax.control.planners._plans import tuned as tuned
from sfkd_jax.control.planners._risk import risk_measure as risk_measure
from sfkd_jax.control.planners._smoothing import plan_smoother as plan_smoother
from sfkd_jax.control.planners._smoothing import (
    savitzky_golay_weights as savitzky_golay_weights,
)
from sfkd_jax.control.planners._weights import (
    effective_sample_size as effective_sample_size,
)
from sfkd_jax.control.planners._weights import softmin as softmin
from sfkd_jax.control.planners._weights import (
    temperature_for_sample_size as temperature_for_sample_size,
)
from sfkd_jax.control.tasks._along_path import Preview as Preview
from sfkd_jax.control.tasks._along_path import along_reference as along_reference
from sfkd_jax.control.tasks._along_path import curvature_ahead as curvature_ahead
from sfkd_jax.control.tasks._along_path import following_law as following_law
from sfkd_jax.control.tasks._along_path import path_coordinates as path_coordinates
from sfkd_jax.control.tasks._constraints import Constraint as Constraint
from sfkd_jax.control.tasks._constraints import at_step as at_step
from sfkd_jax.control.tasks._constraints import constrained as constrained
from sfkd_jax.control.tasks._constraints import inside_limits as inside_limits
from sfkd_jax.control.tasks._constraints import outside_boxes as outside_boxes
from sfkd_jax.control.tasks._constraints import outside_circles as outside_circles
from sfkd_jax.control.tasks._costs import Cost as Cost
from sfkd_jax.control.tasks._costs import StageInputs as StageInputs
from sfkd_jax.control.tasks._costs import tracking_cost as tracking_cost
from sfkd_jax.control.tasks._free_task import free_task as free_task
from sfkd_jax.control.tasks._path_tracking import path_tracking as path_tracking
from sfkd_jax.control.tasks._task import PlanningStart as PlanningStart
from sfkd_jax.control.tasks._task import RolloutSetup as RolloutSetup
from sfkd_jax.control.tasks._task import StepIndex as StepIndex
from sfkd_jax.control.tasks._task import StepResult as StepResult
from sfkd_jax.control.tasks._task import Task as Task
from sfkd_jax.control.tasks._task import actuator_limits as actuator_limits
from sfkd_jax.control.wrappers._adaptation import Adaptation as Adaptation
from sfkd_jax.control.wrappers._adaptation import AdaptiveState as AdaptiveState
from sfkd_jax.control.wrappers._delay import DelayState as DelayState
from sfkd_jax.control.wrappers._delay import delay_compensated as delay_compensated
from sfkd_jax.control.wrappers._guard import FILTER_SCALES as FILTER_SCALES
from sfkd_jax.control.wrappers._guard import Conditions as Conditions
from sfkd_jax.control.wrappers._guard import FilterResult as FilterResult
from sfkd_jax.control.wrappers._guard import NominalState as NominalState
from sfkd_jax.control.wrappers._guard import Shield as Shield
from sfkd_jax.control.wrappers._guard import ShieldState as ShieldState
from sfkd_jax.control.wrappers._guard import safety_filter as safety_filter
from sfkd_jax.control.wrappers._online_tube import OnlineTube as OnlineTube
from sfkd_jax.control.wrappers._online_tube import OnlineTubeState as OnlineTubeState
