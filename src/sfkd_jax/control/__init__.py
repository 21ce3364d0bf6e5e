"""Planners, and the tasks that they solve, for any dynamics."""

from sfkd_jax.control._factory import Stateful as Stateful
from sfkd_jax.control._factory import factory as factory
from sfkd_jax.control._finite import all_finite as all_finite
from sfkd_jax.control._task import Limiter as Limiter
from sfkd_jax.control._task import PlanningStart as PlanningStart
from sfkd_jax.control._task import RolloutSetup as RolloutSetup
from sfkd_jax.control._task import Sample as Sample
from sfkd_jax.control._task import StepIndex as StepIndex
from sfkd_jax.control._task import StepResult as StepResult
from sfkd_jax.control._task import Task as Task
from sfkd_jax.control._task import actuator_limits as actuator_limits
from sfkd_jax.control._task import at_step as at_step
from sfkd_jax.control._task import constrained as constrained
from sfkd_jax.control._task import free_task as free_task
from sfkd_jax.control._task import outside_boxes as outside_boxes
from sfkd_jax.control._task import outside_circles as outside_circles
from sfkd_jax.control.planners._cem import cem as cem
from sfkd_jax.control.planners._gradient import gradient_planner as gradient_planner
from sfkd_jax.control.planners._mppi import mppi as mppi
from sfkd_jax.control.planners._planner import Evaluate as Evaluate
from sfkd_jax.control.planners._planner import Planner as Planner
from sfkd_jax.control.planners._planner import SearchResult as SearchResult
from sfkd_jax.control.planners._planner import Tuning as Tuning
from sfkd_jax.control.planners._planner import tuned as tuned
from sfkd_jax.control.planners._rollouts import Plan as Plan
