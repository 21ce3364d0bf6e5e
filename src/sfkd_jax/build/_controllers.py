"""Controllers from their settings: the planners, and what is built around them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from sfkd_jax import control, plants
from sfkd_jax.geometry import LATERAL
from sfkd_jax.rollout import with_offset
from sfkd_jax.settings import Kinds, Values, arguments, choose, parse, schema
from sfkd_jax.types import Controller, Model

ENV_SOURCES = ("measured", "estimated", "none")
"""Where a controller takes the environment from."""
ROAD_MARGIN = 0.05
"""Relative enlargement of the box of κ and v_ref, since the curvature of a reference is
computed from its points.
"""
ALLOWANCE = 3.0
"""Standard deviations of a measured position by which the tube is enlarged."""


class Planner(NamedTuple):
    """A planner, and whose arguments are its settings.

    Attributes:
        factory: its keyword-only arguments are the settings `controller.NAME`.
        given: of these arguments, those that are decided elsewhere.
        samples: whether it searches around a law (`controller.sampling`).
    """

    factory: Callable[..., Controller]
    given: tuple[str, ...] = ()
    samples: bool = True


_COST = (
    "lateral",
    "course",
    "speed",
    "steering_rate",
    "effort",
    "terminal_weight",
)
"""Of the cost, which all planners share."""
PLANNERS = {
    "mppi": Planner(control.mppi),
    "cem": Planner(control.cem),
    "gradient": Planner(control.gradient_planner),
    "koopman_mpc": Planner(control.koopman_mpc, given=_COST, samples=False),
}
"""Planners by the name under which a controller's settings hold their own. A new one is
an entry here and a file in `conf/controller`.
"""
_IN_PROGRAMS = ("several", "info_level", "sharding", "unroll")
"""Arguments of planners for programs that build their own."""
_BY_PLANT = (
    "dt",
    "wheelbase",
    "speed_loop",
    "control_low",
    "control_high",
    "env_low",
    "env_high",
    "actuator",
)
"""Arguments of controllers that the vehicle and the environment decide."""
_CHANNELS = {"noise_std": 2, "control_rate": 2}
"""One entry for each of the two controls."""


@dataclass(frozen=True, kw_only=True)
class ControllerSettings(Kinds):
    """A planner under a cost.

    Attributes:
        name: of its rows.
        planner: its name in `PLANNERS`; `controller.PLANNER` are its own settings.
        sampling: "feedback" around the path-following law, "model" around that of the
            model, "plain" around nothing, "law" around that of the path coordinates.
        cost: of `control.tracking_cost`.
        task: of `control.path_tracking`.
    """

    name: str
    planner: str = "mppi"
    sampling: str | None = None
    cost: Any = None
    task: Any = None

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the dataclass of the planner of this name."""
        name = values.get("planner", "mppi")
        kind = choose(CONTROLLER_SETTINGS, name, "controller.planner")
        # No defaults here: a run states the settings of the planner that it uses.
        if name not in values:
            raise ValueError(
                f"controller.planner={name} needs the settings controller.{name}; "
                f"choose the option controller={name}"
            )
        return kind

    @property
    def own(self) -> Any:
        """The settings of the planner itself."""
        return getattr(self, self.planner)

    @property
    def horizon(self) -> int:
        """How many steps of the reference the controller reads."""
        return self.own.horizon


@dataclass(frozen=True, kw_only=True)
class SearchSettings(ControllerSettings):
    """A planner that searches around a law, and what is built around it.

    Attributes:
        ancillary: whether the law of the model corrects between plan and prediction.
        shield: whether plans are kept inside the corridor of a certificate.
        adaptive: whether unmeasured forces are estimated while driving.
    """

    ancillary: bool = False
    shield: bool = False
    adaptive: bool = False
    feedback: Any = None
    model_law: Any = None
    adaptation: Any = None
    online_tube: Any = None


def _controller_schema(name: str, planner: Planner) -> type:
    """One dataclass a planner: its own settings, and those of what is around it."""
    skip, given = (*_BY_PLANT, *_IN_PROGRAMS, *planner.given), _BY_PLANT
    parts: dict[str, Any] = {
        name: schema("Planner", None, planner.factory, skip=skip, entries=_CHANNELS),
        "cost": schema("Cost", None, control.tracking_cost, skip=given),
    }
    # A quadratic program has no rate limits and no latent states in its task.
    unused = () if planner.samples else ("control_rate", "latent_weight")
    parts["task"] = schema(
        "Task",
        None,
        control.path_tracking,
        skip=(*given, "ancillary", *unused),
        entries=_CHANNELS,
    )
    if not planner.samples:
        return schema("Controller", ControllerSettings, **parts)
    wrappers = {
        "feedback": (control.path_feedback, ()),
        "model_law": (control.ModelLaw, ()),
        "adaptation": (control.Adaptation, ("inner", "model", "law", "estimate_env")),
        "online_tube": (control.OnlineTube, ("inner", "horizon")),
    }
    parts |= {
        part: schema(part.title(), None, factory, skip=(*given, *decided))
        for part, (factory, decided) in wrappers.items()
    }
    return schema("Controller", SearchSettings, **parts)


CONTROLLER_SETTINGS: dict[str, type] = {
    name: _controller_schema(name, planner) for name, planner in PLANNERS.items()
}


def controller_horizon(settings: ControllerSettings | Values) -> int:
    """Return how many steps of the reference a controller reads."""
    return parse(ControllerSettings, settings, "controller.").horizon


def build_controller(
    settings: ControllerSettings | Values,
    model: Model,
    plant: plants.Vehicle,
    *,
    env_low: Sequence[float] | None = None,
    env_high: Sequence[float] | None = None,
    certificate: Mapping[str, Any] | None = None,
    env_source: str = "measured",
    law: control.PathLaw | None = None,
    adaptive: bool = False,
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
            errors of its inputs while driving, and slows down while its online tube
            does not fit the lane, even if the settings do not say so; with "estimated"
            it always does.

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
    box = {
        "env_low": None if env_low is None else tuple(map(float, env_low)),
        "env_high": None if env_high is None else tuple(map(float, env_high)),
    }
    # A quadratic program samples nothing: no law, shield or adaptation around it.
    searches = settings if isinstance(settings, SearchSettings) else None
    adaptive |= searches is not None and searches.adaptive
    if model.along_path:
        if searches is None or searches.sampling != "law" or law is None:
            raise ValueError(
                "a model in path coordinates needs controller.sampling=law and its law"
            )
        # Whoever estimates e learns the unmeasured forces with the same filter.
        estimates = env_source == "estimated"
        adaptive |= estimates
        # The planner sees the offset; the estimator needs the model as it was learned.
        planned = with_offset(model) if adaptive else model
        along = _along(searches, planned, plant, box, law, certificate)
        if adaptive:
            along = _adaptive(searches, along, model, plant, box, law, estimates)
        size = law.gain.shape[-1]
        # Here and nowhere else observation and reference become ξ and preview.
        controller = control.along_reference(along, coordinates=size)
        if not adaptive:
            return controller
        options = arguments(searches.online_tube, control.OnlineTube)
        tube = control.OnlineTube(inner=controller, horizon=searches.horizon, **options)
        return tube.controller()
    if env_source == "estimated":
        raise ValueError(
            "environment.source=estimated needs a model in path coordinates: "
            "model.frame=path"
        )
    if adaptive:
        raise ValueError("adaptation needs a model in path coordinates")
    if searches is None:
        return _koopman_mpc(settings, model, plant, box)
    return _searching(searches, model, plant, box, None)


def _searching(
    settings: SearchSettings,
    model: Model,
    plant: plants.Vehicle,
    box: Mapping[str, Any],
    law: control.PathLaw | None,
) -> Controller:
    """Return a planner that searches around a feedback law.

    The law is the path-following one (`sampling: feedback`), that of the model
    (`sampling: model`) or none (`sampling: plain`). In path coordinates it is the law
    of the policy, which the model contains (`sampling: law`).
    """
    cost = control.tracking_cost(
        dt=plant.dt,
        speed_loop=plant.speed_loop,
        **arguments(settings.cost, control.tracking_cost),
    )
    limits = {
        "dt": plant.dt,
        "control_low": plant.control_low,
        "control_high": plant.control_high,
    }
    if law is not None:
        options = arguments(settings.task, control.following_law)
        task = control.following_law(model, cost, law, **limits, **options)
    else:
        model_law = control.ModelLaw(**arguments(settings.model_law, control.ModelLaw))
        laws = {
            "feedback": control.path_feedback(
                wheelbase=plant.wheelbase,
                speed_loop=plant.speed_loop,
                **arguments(settings.feedback, control.path_feedback),
            ),
            "model": model_law,
            "plain": control.no_feedback(speed_loop=plant.speed_loop),
        }
        task = control.path_tracking(
            model,
            cost,
            choose(laws, settings.sampling, "controller.sampling"),
            **limits,
            ancillary=model_law if settings.ancillary else None,
            **arguments(settings.task, control.path_tracking),
        )
    factory = PLANNERS[settings.planner].factory
    return factory(task, **box, **arguments(settings.own, factory))


def _koopman_mpc(
    settings: ControllerSettings,
    model: Model,
    plant: plants.Vehicle,
    box: Mapping[str, Any],
) -> Controller:
    """Return a quadratic program over a linear predictor, with the planners' cost."""
    return control.koopman_mpc(
        model,
        dt=plant.dt,
        control_low=plant.control_low,
        control_high=plant.control_high,
        speed_loop=plant.speed_loop,
        # Of the task's settings a quadratic program has the terminal weight alone.
        terminal_weight=settings.task.terminal_weight,
        **box,
        **arguments(settings.cost, control.tracking_cost),
        **arguments(settings.own, control.koopman_mpc),
    )


def in_corridor(
    planner: Controller,
    model: Model,
    plant: plants.Vehicle,
    law: control.PathLaw,
    certificate: Mapping[str, Any],
) -> Controller:
    """Return the planner with a shield that keeps the corridor of a certificate.

    Outside the boxes of ξ, e, κ and v_ref the law acts alone. The box of e_y contains
    the corridor, since the claim holds there, whether or not the data reach that far.

    Args:
        planner: any controller along a path, see `control.along_reference`.
        model: in path coordinates.
        plant: vehicle, whose limits the controls keep.
        law: around which the model was learned.
        certificate: with a corridor.
    """
    corridor, boxes = certificate["corridor"], certificate["boxes"]
    bounds, sensors = corridor["bounds"], corridor["conditions"]["sensor_noise"]
    # [2:] are κ and v_ref; ν has its limits in the law.
    low = tuple(edge - ROAD_MARGIN * abs(edge) for edge in boxes["control"][0][2:])
    high = tuple(edge + ROAD_MARGIN * abs(edge) for edge in boxes["control"][1][2:])
    # The larger entry of a position: which one is lateral depends on the road.
    allowance = ALLOWANCE * max(sensors[:2], default=0.0)
    edge = corridor["corridor_m"] + allowance
    state_low, state_high = (list(side) for side in boxes["state"])
    state_low[LATERAL] = min(state_low[LATERAL], -edge)
    state_high[LATERAL] = max(state_high[LATERAL], edge)
    env_low, env_high = map(tuple, boxes["env"])
    return control.Shield(
        inner=planner,
        model=model,
        law=law,
        width=bounds["nominal"],
        tube=bounds["vehicle_to_nominal_position"],
        horizon=corridor["shield_horizon"],
        noise_allowance=allowance,
        control=(plant.control_low, plant.control_high),
        conditions=control.Conditions(
            env=(env_low, env_high),
            state=(tuple(state_low), tuple(state_high)),
            road=(low, high),
        ),
    ).controller()


def _along(
    settings: SearchSettings,
    model: Model,
    plant: plants.Vehicle,
    box: Mapping[str, Any],
    law: control.PathLaw,
    certificate: Mapping[str, Any] | None,
) -> Controller:
    """Return the planner along a path, with its shield if it has one."""
    planner = _searching(settings, model, plant, box, law)
    # A shield needs a certified corridor; without one the planner drives alone.
    if certificate and certificate.get("corridor") and settings.shield:
        return in_corridor(planner, model, plant, law, certificate)
    return planner


def _adaptive(
    settings: SearchSettings,
    inner: Controller,
    model: Model,
    plant: plants.Vehicle,
    box: Mapping[str, Any],
    law: control.PathLaw,
    estimate_env: bool,
) -> Controller:
    """Return the controller along a path with adaptation, still along a path."""
    # The filter relates forces to the largest one in E, which the box defines.
    if None in box.values():
        raise ValueError("adaptation needs environment.low and environment.high")
    return control.Adaptation(
        inner=inner,
        model=model,
        law=law,
        control_low=plant.control_low,
        control_high=plant.control_high,
        **box,
        estimate_env=estimate_env,
        **arguments(settings.adaptation, control.Adaptation),
    ).controller()
