"""Controllers from their settings: a planner, and what is built around it."""

from __future__ import annotations

from typing import Any, NamedTuple

from sfkd_jax import control
from sfkd_jax.assembly._controller_settings import (
    PLANNERS,
    ControllerSettings,
    SearchSettings,
    controller_horizon,
)
from sfkd_jax.assembly._corridor import (
    Corner,
    conditions_of,
    in_corridor,
    measurement_tests,
)
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.path_coordinates import (
    PATH_FRAME,
)
from sfkd_jax.latency import NO_LATENCY, CommandDelay, Latency
from sfkd_jax.rollout import with_offset
from sfkd_jax.settings import Values, arguments, choose, parse
from sfkd_jax.types import Controller, Model

FEWEST_STEPS = 2
"""Steps of a reference that have a curvature between them."""
MODEL_ERROR = {
    "e_y": 1e-3,
    "e_psi": 3e-4,
    "v": 3e-3,
    "v_y": 3e-3,
    "yaw_rate": 1.5e-3,
    "steering": 5e-4,
}
"""Standard deviation of one step of the models that ship, by path coordinate."""


def build_controller(
    settings: ControllerSettings | Values,
    model: Model,
    plant: plants.Vehicle,
    *,
    env_low: Corner = None,
    env_high: Corner = None,
    certificate: DrivingCertificate | None = None,
    env_source: str = "measured",
    law: path_following.PathLaw | None = None,
    adaptive: bool = False,
    planner: Controller | None = None,
    latency: Latency = NO_LATENCY,
) -> Controller:
    """Return the planner of the settings with its shield and adaptation.

    Args:
        settings: of the controller.
        model: the planner predicts with.
        plant: vehicle, whose limits the controls keep.
        env_low: lower ends of the environment box E.
        env_high: upper ends of E.
        certificate: with a corridor and `settings.shield`, of a shield.
        env_source: one of `ENV_SOURCES`; "estimated" needs path coordinates.
        law: that a model in path coordinates was learned around.
        adaptive: whether a controller along a path estimates unmeasured forces and
            errors of its inputs while driving, even if the settings do not say so; with
            "estimated" it always does.
        planner: along a path, to be shielded in place of that of the settings.
        latency: of the vehicle, which a controller along a path takes into account.

    Raises:
        ValueError: an unknown planner, a horizon of one step, a vehicle without limits
            of its controls, a model and a planner in different coordinates, or
            adaptation or latency without path coordinates.
    """
    settings = parse(ControllerSettings, settings, "controller.")
    if settings.horizon < FEWEST_STEPS:
        raise ValueError(
            f"controller.{settings.planner}.horizon={settings.horizon} is too short: "
            f"the curvature of a road is that between {FEWEST_STEPS} points"
        )
    # A vehicle of logs has no limits before its logs are read.
    if not plant.control_low:
        raise ValueError(
            "a controller needs vehicle.control_low and vehicle.control_high, "
            "as in [-0.4,-3.0]"
        )
    env_box = {"env_low": _as_floats(env_low), "env_high": _as_floats(env_high)}
    # Whoever estimates e learns the unmeasured forces with the same filter.
    estimates_env = env_source == "estimated"
    adaptive = adaptive or estimates_env
    if isinstance(settings, SearchSettings):
        adaptive = adaptive or settings.adaptive
    if model.frame is not PATH_FRAME:
        if adaptive:
            raise ValueError(
                "adaptation and environment.source=estimated need a model "
                "in path coordinates: model.frame=path"
            )
        if not latency.is_none:
            raise ValueError(
                "latency needs a model in path coordinates: model.frame=path"
            )
        return _planner_in_the_world(settings, model, plant, env_box)
    # A quadratic program samples nothing: no law, shield or adaptation around it.
    if (
        not isinstance(settings, SearchSettings)
        or settings.sampling != "law"
        or law is None
    ):
        raise ValueError(
            "a model in path coordinates needs controller.sampling=law and its law"
        )
    sized = latency.sized(len(plant.states), len(plant.controls))
    tolerance = 0.0
    # It is estimated from innovations, which only a corridor has calibrated.
    if certificate is not None and certificate.corridor is not None:
        tolerance = 0.0 if estimates_env else settings.latency_tolerance
    delay = sized.loop(plant.dt, tolerance)
    loop = _Loop(model, plant, law, env_box, estimates_env, sized, delay)
    return _layers(settings, loop, certificate, adaptive=adaptive, planner=planner)


def _layers(
    settings: SearchSettings,
    loop: _Loop,
    certificate: DrivingCertificate | None,
    *,
    adaptive: bool,
    planner: Controller | None,
) -> Controller:
    """Return a controller along a path with its layers, from the inside to the outside.

    These are planner, shield, prediction, adaptation, gate and projection.
    """
    inner = planner
    if inner is None:
        inner = _planner_along_path(settings, loop, adaptive=adaptive)
    certified = loop.model
    predicting = loop.model.predicting
    if adaptive:
        certified = with_offset(certified)
        predicting = with_offset(predicting)
    # A shield needs a certified corridor; without one the planner drives alone.
    shielded = planner is not None or settings.shield
    if shielded and certificate is not None and certificate.corridor is not None:
        inner = in_corridor(
            inner, certified, loop.plant, loop.law, certificate, latency=loop.latency
        )
    if loop.delay.steps:
        inner = _predicting(inner, predicting, loop, certificate)
    if adaptive:
        inner = _adapting(inner, settings, loop)
    return _along_reference(inner, settings, loop, certificate)


class _Loop(NamedTuple):
    """What all layers of a controller along a path are about.

    Attributes:
        model: the certified model, in path coordinates.
        plant: vehicle, whose limits the controls keep.
        law: around which the model was learned.
        env_box: corners env_low and env_high of the box of e, None if unknown.
        estimates_env: whether e is estimated while driving, not measured.
        latency: of the vehicle, for each state and control.
        delay: of the commands after an observation.
    """

    model: Model
    plant: plants.Vehicle
    law: path_following.PathLaw
    env_box: dict[str, Any]
    estimates_env: bool
    latency: Latency
    delay: CommandDelay


def _as_floats(corner: Corner) -> tuple[float, ...] | None:
    """Return a corner of the box of e as plain numbers, or None if it is unknown."""
    return None if corner is None else tuple(map(float, corner))


def _limits(plant: plants.Vehicle) -> dict[str, Any]:
    """Return the limits of the controls of a vehicle, as arguments of factories."""
    return {"control_low": plant.control_low, "control_high": plant.control_high}


def _cost(settings: ControllerSettings, plant: plants.Vehicle) -> path_following.Cost:
    """Return the cost of tracking a reference."""
    return path_following.tracking_cost(
        dt=plant.dt,
        speed_loop=plant.speed_loop,
        **arguments(settings.cost, path_following.tracking_cost),
    )


def _planner_in_the_world(
    settings: ControllerSettings,
    model: Model,
    plant: plants.Vehicle,
    env_box: dict[str, Any],
) -> Controller:
    """Return the planner of the settings with a model in the frame of the world."""
    factory = PLANNERS[settings.planner]
    options = {**env_box, **arguments(settings.planner_settings, factory)}
    if isinstance(settings, SearchSettings):
        return factory(_tracking_task(settings, model, plant), **options)
    # Of the task's settings a quadratic program has the terminal weight alone.
    return factory(
        model,
        _cost(settings, plant),
        **_limits(plant),
        terminal_weight=settings.task.terminal_weight,
        **options,
    )


def _tracking_task(
    settings: SearchSettings, model: Model, plant: plants.Vehicle
) -> control.Task:
    """Return the task of tracking a path around the law that `sampling` names."""
    feedback = path_following.path_feedback(
        wheelbase=plant.wheelbase,
        speed_loop=plant.speed_loop,
        **arguments(settings.feedback, path_following.path_feedback),
    )
    laws = {
        "feedback": feedback,
        "plain": path_following.no_feedback(speed_loop=plant.speed_loop),
    }
    return path_following.path_tracking(
        model.predicting,
        _cost(settings, plant),
        choose(laws, settings.sampling, "controller.sampling"),
        dt=plant.dt,
        **_limits(plant),
        **arguments(settings.task, path_following.path_tracking),
    )


def _planner_along_path(
    settings: SearchSettings, loop: _Loop, *, adaptive: bool
) -> Controller:
    """Return the planner of the settings with a model in path coordinates.

    Args:
        settings: of the controller.
        loop: the closed loop.
        adaptive: whether it predicts with the offset that an adaptation around it
            estimates, see `rollout.with_offset`.
    """
    predicts = loop.model.predicting
    if adaptive:
        predicts = with_offset(predicts)
    task = path_following.following_law(
        predicts,
        _cost(settings, loop.plant),
        loop.law,
        dt=loop.plant.dt,
        **_limits(loop.plant),
        **arguments(settings.task, path_following.following_law),
    )
    factory = PLANNERS[settings.planner]
    options = arguments(settings.planner_settings, factory)
    return factory(task, **{**loop.env_box, **options})


def _adapting(inner: Controller, settings: SearchSettings, loop: _Loop) -> Controller:
    """Return a controller along a path behind the estimator of unmeasured forces."""
    # The filter relates forces to the largest one in E, which the box defines.
    if None in loop.env_box.values():
        raise ValueError("adaptation needs environment.low and environment.high")
    options = arguments(settings.adaptation, path_following.Adaptation)
    if not options["sensor_noise"]:
        options["sensor_noise"] = _noise_to_learn_from(loop.plant)
    if not options["model_error"]:
        options["model_error"] = _error_of_known_states(loop.plant)
    adaptation = path_following.Adaptation(
        inner=inner,
        # Without the offset, which the filter itself adds.
        model=loop.model.predicting,
        law=loop.law,
        estimate_env=loop.estimates_env,
        delay=loop.delay,
        **_limits(loop.plant),
        **loop.env_box,
        **options,
    )
    return adaptation.controller()


def _predicting(
    inner: Controller,
    model: Model,
    loop: _Loop,
    certificate: DrivingCertificate | None,
) -> Controller:
    """Return a controller along a path on the state at which its command will act."""
    predictor = path_following.Predictor(
        inner=inner,
        prediction=_prediction(model, loop, certificate),
        delay=loop.delay,
    )
    return predictor.controller()


def _prediction(
    model: Model, loop: _Loop, certificate: DrivingCertificate | None
) -> path_following.Prediction:
    """Return the prediction of a loop by a model, under the certified conditions."""
    return path_following.Prediction(
        model=model,
        law=loop.law,
        dt=loop.plant.dt,
        conditions=conditions_of(certificate, **loop.env_box),
    )


def _noise_to_learn_from(plant: plants.Vehicle) -> tuple[float, ...]:
    """Return the deviations of the sensors of a vehicle, none of which may be exact."""
    # A filter weighs what it measures by these: an exact sensor would weigh infinitely.
    exact = [state.name for state in plant.states if not state.deviation]
    if exact:
        raise ValueError(
            f"adaptation needs the deviation of the sensor of {', '.join(exact)}: "
            "state it in the vehicle or pass controller.adaptation.sensor_noise"
        )
    return plant.sensor_noise


def _error_of_known_states(plant: plants.Vehicle) -> tuple[float, ...]:
    """Return the error of one step of a model, for each path coordinate."""
    names = [state.name for state in plants.path_states(plant)[3:]]
    unknown = [name for name in names if name not in MODEL_ERROR]
    if unknown:
        raise ValueError(
            f"adaptation needs the error of the model in {', '.join(unknown)}: pass "
            f"controller.adaptation.model_error of {', '.join(names)}; open_loop.json "
            "of the run has them as one_step_rmse"
        )
    return tuple(MODEL_ERROR[name] for name in names)


def _along_reference(
    inner: Controller,
    settings: SearchSettings,
    loop: _Loop,
    certificate: DrivingCertificate | None,
) -> Controller:
    """Return a controller along a path behind its gate, as one of references."""
    tests = path_following.MeasurementTests()
    if certificate is not None and certificate.corridor is not None:
        tests = measurement_tests(
            certificate.corridor,
            loop.plant,
            estimates_env=loop.estimates_env,
            later=loop.delay.hypotheses,
        )
    gate = path_following.Gate(
        inner=inner,
        prediction=_prediction(loop.model.predicting, loop, certificate),
        horizon=controller_horizon(settings, loop.delay),
        reads_env=not loop.estimates_env,
        tests=tests,
        delay=loop.delay,
        **arguments(settings.gate, path_following.Gate),
    )
    # Here and nowhere else observation and reference become ξ and preview.
    coordinates = loop.law.gain.shape[-1]
    return path_following.along_reference(
        gate.controller(),
        coordinates=coordinates,
        delay=loop.delay,
        hold_back=loop.latency.hold_back(loop.plant.dt),
    )
