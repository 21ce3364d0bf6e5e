"""Path following: laws, tasks, the layers around a planner, and lanes."""

from sfkd_jax.driving.path_following.lanes._in_lane import InLane as InLane
from sfkd_jax.driving.path_following.lanes._in_lane import in_lane as in_lane
from sfkd_jax.driving.path_following.lanes._in_lane import moved_on as moved_on
from sfkd_jax.driving.path_following.lanes._judging import Class as Class
from sfkd_jax.driving.path_following.lanes._manoeuvre import Manoeuvres as Manoeuvres
from sfkd_jax.driving.path_following.lanes._reversing import Reversing as Reversing
from sfkd_jax.driving.path_following.laws._derivation import (
    by_differences as by_differences,
)
from sfkd_jax.driving.path_following.laws._derivation import (
    derive_path_law as derive_path_law,
)
from sfkd_jax.driving.path_following.laws._feedback import (
    LinearFeedback as LinearFeedback,
)
from sfkd_jax.driving.path_following.laws._feedback import PathErrors as PathErrors
from sfkd_jax.driving.path_following.laws._feedback import no_feedback as no_feedback
from sfkd_jax.driving.path_following.laws._feedback import path_errors as path_errors
from sfkd_jax.driving.path_following.laws._feedback import (
    path_feedback as path_feedback,
)
from sfkd_jax.driving.path_following.laws._path_law import TEXTBOOK as TEXTBOOK
from sfkd_jax.driving.path_following.laws._path_law import PathLaw as PathLaw
from sfkd_jax.driving.path_following.laws._path_law import (
    law_from_arrays as law_from_arrays,
)
from sfkd_jax.driving.path_following.laws._path_law import textbook_law as textbook_law
from sfkd_jax.driving.path_following.laws._steady_turn import NEAR as NEAR
from sfkd_jax.driving.path_following.laws._table_check import (
    checked_law as checked_law,
)
from sfkd_jax.driving.path_following.laws._table_check import (
    unsettled_coordinates as unsettled_coordinates,
)
from sfkd_jax.driving.path_following.tasks._along_path import (
    along_reference as along_reference,
)
from sfkd_jax.driving.path_following.tasks._along_path import (
    following_law as following_law,
)
from sfkd_jax.driving.path_following.tasks._path_tracking import Cost as Cost
from sfkd_jax.driving.path_following.tasks._path_tracking import (
    PathTarget as PathTarget,
)
from sfkd_jax.driving.path_following.tasks._path_tracking import (
    StageInputs as StageInputs,
)
from sfkd_jax.driving.path_following.tasks._path_tracking import (
    check_path as check_path,
)
from sfkd_jax.driving.path_following.tasks._path_tracking import (
    path_tracking as path_tracking,
)
from sfkd_jax.driving.path_following.tasks._path_tracking import (
    tracking_cost as tracking_cost,
)
from sfkd_jax.driving.path_following.tasks._world_planner import (
    in_the_world as in_the_world,
)
from sfkd_jax.driving.path_following.wrappers._adaptation import (
    Adaptation as Adaptation,
)
from sfkd_jax.driving.path_following.wrappers._conditions import Box as Box
from sfkd_jax.driving.path_following.wrappers._conditions import (
    Conditions as Conditions,
)
from sfkd_jax.driving.path_following.wrappers._corridor_filter import (
    corridor_filter as corridor_filter,
)
from sfkd_jax.driving.path_following.wrappers._delays import (
    DelayEstimator as DelayEstimator,
)
from sfkd_jax.driving.path_following.wrappers._delays import (
    delay_estimator as delay_estimator,
)
from sfkd_jax.driving.path_following.wrappers._gate import Gate as Gate
from sfkd_jax.driving.path_following.wrappers._innovations import WINDOWS as WINDOWS
from sfkd_jax.driving.path_following.wrappers._innovations import (
    InnovationTest as InnovationTest,
)
from sfkd_jax.driving.path_following.wrappers._innovations import (
    expected_coordinates as expected_coordinates,
)
from sfkd_jax.driving.path_following.wrappers._innovations import (
    innovation_test as innovation_test,
)
from sfkd_jax.driving.path_following.wrappers._innovations import (
    turning_rate as turning_rate,
)
from sfkd_jax.driving.path_following.wrappers._measurement_tests import (
    MeasurementTests as MeasurementTests,
)
from sfkd_jax.driving.path_following.wrappers._odometry import (
    OdometryTest as OdometryTest,
)
from sfkd_jax.driving.path_following.wrappers._prediction import Periods as Periods
from sfkd_jax.driving.path_following.wrappers._prediction import (
    Prediction as Prediction,
)
from sfkd_jax.driving.path_following.wrappers._prediction import Predictor as Predictor
from sfkd_jax.driving.path_following.wrappers._prediction import (
    periods_ahead as periods_ahead,
)
from sfkd_jax.driving.path_following.wrappers._shield import Shield as Shield
