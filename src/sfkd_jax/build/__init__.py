"""Build vehicles, models, scenarios and controllers from plain settings."""

from sfkd_jax.build._choices import Settings as Settings
from sfkd_jax.build._choices import as_kwargs as as_kwargs
from sfkd_jax.build._choices import choose as choose
from sfkd_jax.build._controllers import ENV_SOURCES as ENV_SOURCES
from sfkd_jax.build._controllers import build_controller as build_controller
from sfkd_jax.build._controllers import in_corridor as in_corridor
from sfkd_jax.build._planners import PLANNERS as PLANNERS
from sfkd_jax.build._planners import Planner as Planner
from sfkd_jax.build._planners import controller_horizon as controller_horizon
from sfkd_jax.build._plants import INNER_LOOPS as INNER_LOOPS
from sfkd_jax.build._plants import MODELS as MODELS
from sfkd_jax.build._plants import PLANTS as PLANTS
from sfkd_jax.build._plants import build_driver as build_driver
from sfkd_jax.build._plants import build_model as build_model
from sfkd_jax.build._plants import build_scenario as build_scenario
from sfkd_jax.build._plants import build_vehicle as build_vehicle
from sfkd_jax.build._plants import check_imported as check_imported
from sfkd_jax.build._plants import space_from_settings as space_from_settings
from sfkd_jax.build._plants import space_to_settings as space_to_settings
from sfkd_jax.build._systems import System as System
from sfkd_jax.build._systems import build_law as build_law
from sfkd_jax.build._systems import build_loop as build_loop
from sfkd_jax.build._systems import reference_systems as reference_systems
