"""Controllers from their settings: a planner, and what is built around it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sfkd_jax import control
from sfkd_jax.assembly._controller_settings import (
    PLANNERS,
    ControllerSettings,
    SearchSettings,
)
from sfkd_jax.assembly._corridor import Corner, conditions_of, corridor_of, in_corridor
from sfkd_jax.driving import path_following, plants
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.path_coordinates import (
    CURVATURE,
    HEADING,
    PATH_FRAME,
    PATH_SPEED,
    REFERENCE_SPEED,
)
from sfkd_jax.rollout import with_offset
from sfkd_jax.settings import Values, arguments, choose, parse
from sfkd_jax.types import Controller, Model

REFERENCE_SEARCH = {
    "horizon": 1,
    "noise_std": (1.5, 10.0, 1.5, 10.0, 1.0),
    "noise": "white",
}
"""Settings of every planner that searches for a reference in a lane."""
REFERENCE_PLANNERS: dict[str, Any] = {
    "mppi": {"num_samples": 300, "effective_samples": 5.0},
    "cem": {"num_samples": 100, "iterations": 3, "elites": 10},
}
"""Further settings of such a planner, by its name."""
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

    Raises:
        ValueError: an unknown planner, a vehicle without limits of its controls, a
            model and a planner in different coordinates, or adaptation without path
            coordinates.
    """
    settings = parse(ControllerSettings, settings, "controller.")
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
    loop = _Loop(model, plant, law, env_box, estimates_env)
    # From the inside to the outside: planner, shield, adaptation, gate, projection.
    inner = planner
    if inner is None:
        inner = _planner_along_path(settings, loop, adaptive=adaptive)
    # A shield needs a certified corridor; without one the planner drives alone.
    shielded = planner is not None or settings.shield
    if shielded and certificate is not None and certificate.corridor is not None:
        # It predicts with the certified model, not with that of the planner.
        certified = with_offset(model) if adaptive else model
        inner = in_corridor(inner, certified, plant, law, certificate)
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
    """

    model: Model
    plant: plants.Vehicle
    law: path_following.PathLaw
    env_box: dict[str, Any]
    estimates_env: bool


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
        model.planning or model,
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
    predicts = loop.model.planning or loop.model
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
        model=loop.model.planning or loop.model,
        law=loop.law,
        estimate_env=loop.estimates_env,
        **_limits(loop.plant),
        **loop.env_box,
        **options,
    )
    return adaptation.controller()


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
    corridor = certificate.corridor if certificate else None
    test = None
    if corridor is not None and not loop.estimates_env:
        calibrated = corridor.innovations
        test = path_following.innovation_test(
            calibrated.levels, calibrated.deviation, calibrated.threshold
        )
    gate = path_following.Gate(
        inner=inner,
        model=loop.model,
        law=loop.law,
        dt=loop.plant.dt,
        horizon=settings.horizon,
        conditions=conditions_of(certificate, **loop.env_box),
        reads_env=not loop.estimates_env,
        test=test,
        **arguments(settings.gate, path_following.Gate),
    )
    # Here and nowhere else observation and reference become ξ and preview.
    coordinates = loop.law.gain.shape[-1]
    return path_following.along_reference(gate.controller(), coordinates=coordinates)


def build_in_lane(
    inner: Controller,
    plant: plants.Vehicle,
    law: path_following.PathLaw,
    certificate: DrivingCertificate,
    *,
    horizon: int,
    car: tuple[float, float],
    planner: str,
    friction: int | None,
) -> Controller:
    """Return a controller that drives in a lane, see `path_following.InLane`.

    Args:
        inner: the shielded controller of references.
        plant: vehicle.
        law: around which the model was learned.
        certificate: with a corridor, whose class the references keep.
        horizon: how many steps of the reference `inner` reads.
        car: length and width [m].
        planner: that searches for a reference, in `PLANNERS`.
        friction: entry of e that is the friction; None if none is.
    """
    admissible = _admissible_references(plant, law, certificate, car)
    manoeuvres = path_following.Manoeuvres(kind=admissible, dt=plant.dt)
    options = {**REFERENCE_SEARCH, **REFERENCE_PLANNERS.get(planner, {})}
    speed_gain = float(np.mean(law.gain[..., 1, PATH_SPEED]))
    return path_following.in_lane(
        inner=inner,
        planner=PLANNERS[planner](manoeuvres.task(), **options),
        manoeuvres=manoeuvres,
        horizon=horizon,
        lead=0.0 if plant.speed_loop else 1.0 / speed_gain,
        friction=friction,
        lowest=certificate.measured.boxes.env[0][friction or 0],
    )


def _admissible_references(
    plant: plants.Vehicle,
    law: path_following.PathLaw,
    certificate: DrivingCertificate,
    car: tuple[float, float],
) -> path_following.Class:
    """Return the class of references of which a corridor was certified."""
    corridor = corridor_of(certificate)
    conditions = corridor.conditions
    road_low, road_high = certificate.measured.boxes.control
    state_box = conditions_of(certificate).state
    heading = 0.0
    if state_box is not None:
        heading = max(abs(end[HEADING]) for end in state_box)
    return path_following.Class(
        curvature=min(conditions.peak_curvature, road_high[CURVATURE]),
        turning=conditions.curvature_slope,
        lateral=min(conditions.lateral_acceleration, float(law.high[0])),
        jerk=conditions.lateral_jerk,
        speed=(road_low[REFERENCE_SPEED], road_high[REFERENCE_SPEED]),
        half=(0.5 * car[0], 0.5 * car[1]),
        corridor=corridor.corridor_m,
        heading=heading,
        change=conditions.acceleration,
        # The rest is left for what the speed lags behind.
        deceleration=0.75 * conditions.acceleration,
        braking=6.0 if plant.speed_loop else -plant.control_low[1],
    )
