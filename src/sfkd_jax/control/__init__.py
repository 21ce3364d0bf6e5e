"""Controllers: tasks, planners, feedback laws and wrappers, for any dynamics."""

from sfkd_jax.control._factory import factory
from sfkd_jax.control.laws._feedback import (
    FeedbackLaw,
    ModelLaw,
    PathErrors,
    no_feedback,
    path_errors,
    path_feedback,
)
from sfkd_jax.control.laws._path_law import (
    PathLaw,
    derive_path_law,
    law_from_arrays,
)
from sfkd_jax.control.planners._cem import cem
from sfkd_jax.control.planners._gradient import gradient_planner
from sfkd_jax.control.planners._koopman_mpc import koopman_mpc
from sfkd_jax.control.planners._mppi import mppi
from sfkd_jax.control.planners._planner import Planner, SearchResult, tuned
from sfkd_jax.control.tasks._along_path import along_reference, following_law
from sfkd_jax.control.tasks._constraints import (
    at_step,
    constrained,
    outside_boxes,
    outside_circles,
)
from sfkd_jax.control.tasks._environments import over_environments
from sfkd_jax.control.tasks._free_task import free_task
from sfkd_jax.control.tasks._path_tracking import (
    Cost,
    StageInputs,
    path_tracking,
    tracking_cost,
)
from sfkd_jax.control.tasks._task import (
    PlanningStart,
    RolloutSetup,
    StepResult,
    Task,
)
from sfkd_jax.control.wrappers._adaptation import Adaptation
from sfkd_jax.control.wrappers._delay import delay_compensated
from sfkd_jax.control.wrappers._guard import (
    FILTER_SCALES,
    Conditions,
    Shield,
    safety_filter,
)
from sfkd_jax.control.wrappers._online_tube import OnlineTube
from sfkd_jax.geometry import reference_curvature

# tasks
__all__ = [
    "Cost",
    "PlanningStart",
    "RolloutSetup",
    "StageInputs",
    "StepResult",
    "Task",
    "along_reference",
    "at_step",
    "constrained",
    "following_law",
    "free_task",
    "outside_boxes",
    "outside_circles",
    "over_environments",
    "path_tracking",
    "tracking_cost",
]
# planners
__all__ += [
    "Planner",
    "SearchResult",
    "cem",
    "factory",
    "gradient_planner",
    "koopman_mpc",
    "mppi",
    "tuned",
]
# laws
__all__ += [
    "FeedbackLaw",
    "ModelLaw",
    "PathErrors",
    "PathLaw",
    "derive_path_law",
    "law_from_arrays",
    "no_feedback",
    "path_errors",
    "path_feedback",
    "reference_curvature",
]
# wrappers
__all__ += [
    "FILTER_SCALES",
    "Adaptation",
    "Conditions",
    "OnlineTube",
    "Shield",
    "delay_compensated",
    "safety_filter",
]
