"""Build vehicles, models, scenarios, laws and controllers from their settings.

Every function takes an object of settings, or plain values that are parsed into one.
"""

from sfkd_jax.build._controllers import CONTROLLER_SETTINGS as CONTROLLER_SETTINGS
from sfkd_jax.build._controllers import ENV_SOURCES as ENV_SOURCES
from sfkd_jax.build._controllers import PLANNERS as PLANNERS
from sfkd_jax.build._controllers import ControllerSettings as ControllerSettings
from sfkd_jax.build._controllers import Planner as Planner
from sfkd_jax.build._controllers import SearchSettings as SearchSettings
from sfkd_jax.build._controllers import build_controller as build_controller
from sfkd_jax.build._controllers import controller_horizon as controller_horizon
from sfkd_jax.build._controllers import in_corridor as in_corridor
from sfkd_jax.build._plants import INNER_LOOPS as INNER_LOOPS
from sfkd_jax.build._plants import MODEL_SETTINGS as MODEL_SETTINGS
from sfkd_jax.build._plants import MODELS as MODELS
from sfkd_jax.build._plants import PLANTS as PLANTS
from sfkd_jax.build._plants import SCENARIO as SCENARIO
from sfkd_jax.build._plants import VEHICLES as VEHICLES
from sfkd_jax.build._plants import Directory as Directory
from sfkd_jax.build._plants import LawSettings as LawSettings
from sfkd_jax.build._plants import ModelSettings as ModelSettings
from sfkd_jax.build._plants import ScenarioSettings as ScenarioSettings
from sfkd_jax.build._plants import System as System
from sfkd_jax.build._plants import VehicleSettings as VehicleSettings
from sfkd_jax.build._plants import build_driver as build_driver
from sfkd_jax.build._plants import build_law as build_law
from sfkd_jax.build._plants import build_loop as build_loop
from sfkd_jax.build._plants import build_model as build_model
from sfkd_jax.build._plants import build_scenario as build_scenario
from sfkd_jax.build._plants import build_vehicle as build_vehicle
from sfkd_jax.build._plants import check_imported as check_imported
from sfkd_jax.build._plants import reference_systems as reference_systems
from sfkd_jax.build._plants import space_from_settings as space_from_settings
from sfkd_jax.build._plants import space_to_settings as space_to_settings
