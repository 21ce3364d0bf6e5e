"""Controllers from their settings: the planners, and what is built around them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from sfkd_jax import control, plants
from sfkd_jax.geometry import CURVATURE, HEADING, LATERAL, PATH_SPEED, REFERENCE_SPEED
from sfkd_jax.rollout import with_offset
from sfkd_jax.settings import Values, arguments, choose, parse, schema, takes
from sfkd_jax.types import Controller, Model

ENV_SOURCES = ("measured", "estimated", "none")
"""Where a controller takes the environment from."""
ROAD_MARGIN = 0.05
"""Relative enlargement of the box of κ and v_ref, since the curvature of a reference is
computed from its points.
"""
STATE_MARGIN = 0.25
"""Relative enlargement of the box of ξ: the runs on which a corridor is calibrated
leave the box of the data as well.
"""
ALLOWANCE = 3.0
"""Standard deviations of a measured position by which the tube is enlarged."""
Corner = Sequence[float] | None
"""Lower or upper ends of the environment box E, if they are known."""


SEARCH = {"horizon": 1, "noise_std": (1.5, 10.0, 1.5, 10.0, 1.0), "noise": "white"}
"""Of a planner of references."""
SEARCHES: dict[str, Any] = {
    "mppi": {"num_samples": 300, "effective_samples": 5.0},
    "cem": {"num_samples": 100, "iterations": 3, "elites": 10},
}


PLANNERS: dict[str, Callable[..., Controller]] = {
    "mppi": control.mppi,
    "cem": control.cem,
    "gradient": control.gradient_planner,
    "koopman_mpc": control.koopman_mpc,
}
"""Planners by the name under which a controller's settings hold their own: the
keyword-only arguments. A new one is an entry here and a file in `conf/controller`.
"""
QUADRATIC = ("koopman_mpc",)
"""Planners that solve a quadratic program: they search around no law."""
_DECIDED = (
    *("dt", "wheelbase", "speed_loop", "control_low", "control_high"),
    *("env_low", "env_high", "estimate_env", "inner", "model", "law"),
    *("conditions", "reads_env", "test"),
)
"""Arguments of controllers that vehicle, environment and model decide, and those for
programs that build their own.
"""


@takes()
class ControllerSettings:
    """A planner under a cost.

    Attributes:
        name: of its rows.
        planner: its name in `PLANNERS`; `controller.PLANNER` are its own settings.
        sampling: "feedback" around the path-following law, "plain" around nothing,
            "law" around that of the path coordinates.
        cost: of `control.tracking_cost`.
        task: of `control.path_tracking`.
    """

    name: str
    planner: str = "mppi"
    sampling: str | None = None
    cost: Any = None
    task: Any = None

    @classmethod
    def subclass_for(cls, values: Values) -> type[ControllerSettings]:
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


@takes()
class SearchSettings(ControllerSettings):
    """A planner that searches around a law, and what is built around it.

    Attributes:
        shield: whether plans are kept inside the corridor of a certificate.
        adaptive: whether unmeasured forces are estimated while driving.
    """

    shield: bool = False
    adaptive: bool = False
    feedback: Any = None
    gate: Any = None
    adaptation: Any = None


def _controller_schema(planner: str) -> type[ControllerSettings]:
    """One dataclass a planner: its own settings, and those of what is around it."""
    factories: dict[str, Callable[..., Any]] = {
        "cost": control.tracking_cost,
        "task": control.path_tracking,
    }
    # A quadratic program has no rate limits in its task.
    base, skip = ControllerSettings, (*_DECIDED, "control_rate")
    if planner not in QUADRATIC:
        base, skip = SearchSettings, _DECIDED
        factories |= {
            "feedback": control.path_feedback,
            "gate": control.Gate,
            "adaptation": control.Adaptation,
        }
    parts: dict[str, Any] = {
        part: schema(part.title(), object, factory, skip=(*skip, "horizon"))
        for part, factory in factories.items()
    }
    # What cost and task state is not stated by the planner once more.
    shared = {
        *arguments(parts["cost"], control.tracking_cost),
        *arguments(parts["task"], control.path_tracking),
    }
    own = schema("Planner", object, PLANNERS[planner], skip=(*_DECIDED, *shared))
    return schema("Controller", base, **{planner: own}, **parts)


CONTROLLER_SETTINGS = {planner: _controller_schema(planner) for planner in PLANNERS}


def controller_horizon(settings: ControllerSettings | Values) -> int:
    """Return how many steps of the reference a controller reads."""
    return parse(ControllerSettings, settings, "controller.").horizon


def build_controller(
    settings: ControllerSettings | Values,
    model: Model,
    plant: plants.Vehicle,
    *,
    env_low: Corner = None,
    env_high: Corner = None,
    certificate: Mapping[str, Any] | None = None,
    env_source: str = "measured",
    law: control.PathLaw | None = None,
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
    limits = {"control_low": plant.control_low, "control_high": plant.control_high}
    ends = {"env_low": env_low, "env_high": env_high}.items()
    box = {k: None if end is None else tuple(map(float, end)) for k, end in ends}
    factory = PLANNERS[settings.planner]
    cost = control.tracking_cost(
        dt=plant.dt,
        speed_loop=plant.speed_loop,
        **arguments(settings.cost, control.tracking_cost),
    )
    own = {**box, **arguments(settings.own, factory)}
    # Here and nowhere else: what guards the planner has the model that is certified.
    rolled = model.planning or model
    # A quadratic program samples nothing: no law, shield or adaptation around it.
    searches = settings if isinstance(settings, SearchSettings) else None
    # Whoever estimates e learns the unmeasured forces with the same filter.
    estimates = env_source == "estimated"
    adaptive |= estimates or (searches is not None and searches.adaptive)
    if not model.along_path:
        if adaptive:
            raise ValueError(
                "adaptation and environment.source=estimated need a model "
                "in path coordinates: model.frame=path"
            )
        if searches is not None:
            return factory(_task(searches, rolled, plant, cost, limits), **own)
        # Of the task's settings a quadratic program has the terminal weight alone.
        weight = settings.task.terminal_weight
        return factory(model, cost, **limits, terminal_weight=weight, **own)
    if searches is None or searches.sampling != "law" or law is None:
        raise ValueError(
            "a model in path coordinates needs controller.sampling=law and its law"
        )
    # The planner sees the offset; the estimator needs the model without it.
    planned, guarded = (with_offset(m) if adaptive else m for m in (rolled, model))
    task = control.following_law(
        planned,
        cost,
        law,
        dt=plant.dt,
        **limits,
        **arguments(settings.task, control.following_law),
    )
    along = planner or factory(task, **own)
    # A shield needs a certified corridor; without one the planner drives alone.
    if certificate and certificate.get("corridor") and (planner or searches.shield):
        along = in_corridor(along, guarded, plant, law, certificate)
    if adaptive:
        # The filter relates forces to the largest one in E, which the box defines.
        if None in box.values():
            raise ValueError("adaptation needs environment.low and environment.high")
        around: Any = {"inner": along, "model": rolled, "law": law, **limits, **box}
        options = arguments(searches.adaptation, control.Adaptation)
        adaptation = control.Adaptation(**around, estimate_env=estimates, **options)
        along = adaptation.controller()
    conditions = _conditions(certificate, env_low, env_high)
    # Of a certificate without a test: it was made before there was one.
    entry = ((certificate or {}).get("corridor") or {}).get("innovations")
    test = control.innovation_test(entry) if entry and not estimates else None
    return _gated(along, searches, model, plant, law, conditions, test, estimates)


def _gated(
    inner: Controller,
    settings: SearchSettings,
    model: Model,
    plant: plants.Vehicle,
    law: control.PathLaw,
    conditions: control.Conditions,
    test: control.InnovationTest | None,
    estimates: bool,
) -> Controller:
    """Return a controller along a path behind the gate of its measurements."""
    gate = control.Gate(
        inner=inner,
        model=model,
        law=law,
        dt=plant.dt,
        horizon=settings.horizon,
        conditions=conditions,
        reads_env=not estimates,
        test=test,
        **arguments(settings.gate, control.Gate),
    )
    # Here and nowhere else observation and reference become ξ and preview.
    return control.along_reference(gate.controller(), coordinates=law.gain.shape[-1])


def _task(
    settings: SearchSettings,
    model: Model,
    plant: plants.Vehicle,
    cost: control.Cost,
    limits: Any,
) -> control.Task:
    """Return the task of tracking a path around the law that `sampling` names."""
    feedback = control.path_feedback(
        wheelbase=plant.wheelbase,
        speed_loop=plant.speed_loop,
        **arguments(settings.feedback, control.path_feedback),
    )
    laws = {
        "feedback": feedback,
        "plain": control.no_feedback(speed_loop=plant.speed_loop),
    }
    law = choose(laws, settings.sampling, "controller.sampling")
    options = arguments(settings.task, control.path_tracking)
    return control.path_tracking(model, cost, law, dt=plant.dt, **limits, **options)


def in_corridor(
    planner: Controller,
    model: Model,
    plant: plants.Vehicle,
    law: control.PathLaw,
    certificate: Mapping[str, Any],
) -> Controller:
    """Return the planner with a shield that keeps the corridor of a certificate.

    Args:
        planner: any controller along a path, see `control.along_reference`.
        model: in path coordinates.
        plant: vehicle, whose limits the controls keep.
        law: around which the model was learned.
        certificate: with a corridor.
    """
    corridor = corridor_of(certificate)
    bounds, sensors = corridor["bounds"], _sensors(corridor)
    # What the heading's noise moves the car sideways until the law has turned it back.
    steering = np.asarray(law.gain)[..., 0, :]
    ratio = float(np.max(steering[..., HEADING] / steering[..., LATERAL]))
    return control.Shield(
        inner=planner,
        model=model,
        law=law,
        width=bounds["nominal"],
        tube=bounds["vehicle_to_nominal_position"],
        horizon=corridor["shield_horizon"],
        noise_allowance=ALLOWANCE * sensors[LATERAL],
        start_error=ALLOWANCE * (sensors[LATERAL] + ratio * sensors[HEADING]),
        decay=certificate["alpha"],
        control=(plant.control_low, plant.control_high),
        conditions=_conditions(certificate),
        dt=plant.dt,
        rear=_rear(law),
        claimed=is_claimed(certificate),
    ).controller()


def corridor_of(certificate: Mapping[str, Any]) -> dict[str, Any]:
    """The corridor of a certificate, with the bounds of recorded runs if it has any."""
    corridor, runs = certificate["corridor"], certificate.get("recorded", {})
    measured = ("bounds", "corridor_m", "level")
    return corridor | {name: runs[name] for name in measured if name in runs}


def is_claimed(certificate: Mapping[str, Any]) -> bool:
    """Whether a corridor was measured on the vehicle, not on a model of its logs."""
    identified = "identified_from" in certificate["corridor"]["conditions"]
    return not identified or "recorded" in certificate


def _rear(law: control.PathLaw) -> float:
    """The slip of a turn that the tyres hardly feel, per curvature [m].

    At one lateral acceleration ψ* differs between two speeds by this times κ alone.
    """
    last = law.state.shape[0] - 1
    # The gentlest turn of the table that is one.
    row = min(last // 2 + 1, last)
    gentle = np.asarray(law.state)[row, ..., HEADING]
    (_, slow, *_), (side, fast, *_) = (np.asarray(end, float) for end in law[:2])
    sideways = side * (2.0 * row / last - 1.0)
    bends = sideways / slow**2 - sideways / fast**2
    return max(float(np.median(gentle[-1] - gentle[0]) / bends), 0.0)


def build_in_lane(
    inner: Controller,
    plant: plants.Vehicle,
    law: control.PathLaw,
    certificate: Mapping[str, Any],
    *,
    horizon: int,
    car: tuple[float, float],
    planner: str,
    friction: int | None,
) -> Controller:
    """Return a controller that drives in a lane, see `control.InLane`.

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
    corridor, road = corridor_of(certificate), certificate["boxes"]["control"]
    under, state = corridor["conditions"], _conditions(certificate).state
    kind = control.Class(
        curvature=min(under["peak_curvature"], road[1][CURVATURE]),
        turning=under["curvature_slope"],
        lateral=min(under["lateral_acceleration"], float(law.high[0])),
        jerk=under["lateral_jerk"],
        speed=(road[0][REFERENCE_SPEED], road[1][REFERENCE_SPEED]),
        half=(0.5 * car[0], 0.5 * car[1]),
        corridor=corridor["corridor_m"],
        heading=0.0 if state is None else max(abs(end[HEADING]) for end in state),
        change=under["acceleration"],
        # The rest is left for what the speed lags behind.
        deceleration=0.75 * under["acceleration"],
        braking=6.0 if plant.speed_loop else -plant.control_low[1],
    )
    follows = float(np.mean(law.gain[..., 1, PATH_SPEED]))
    manoeuvres = control.Manoeuvres(kind=kind, dt=plant.dt)
    search = PLANNERS[planner](manoeuvres.task(), **SEARCH, **SEARCHES.get(planner, {}))
    return control.in_lane(
        inner=inner,
        planner=search,
        manoeuvres=manoeuvres,
        horizon=horizon,
        lead=0.0 if plant.speed_loop else 1.0 / follows,
        friction=friction,
        lowest=certificate["boxes"]["env"][0][friction or 0],
    )


def _sensors(corridor: Mapping[str, Any]) -> tuple[float, float]:
    """Standard deviations of the measured e_y [m] and e_ψ [rad]."""
    noise = (*corridor["conditions"]["sensor_noise"], 0.0, 0.0, 0.0)
    # The larger entry of a position: which one is lateral depends on the road.
    return max(noise[:2]), noise[2]


def _conditions(
    certificate: Mapping[str, Any] | None,
    env_low: Corner = None,
    env_high: Corner = None,
) -> control.Conditions:
    """Where the model predicts, as its certificate says.

    The box of e_y contains the corridor, since the claim holds there, whether or not
    the data reach that far. The other boxes are those of the data, somewhat enlarged:
    the runs on which a corridor is calibrated leave them as well.
    """
    if certificate:
        corridor = certificate.get("corridor") and corridor_of(certificate)
        boxes = certificate["boxes"]
        low, high = (np.asarray(side, float) for side in boxes["state"])
        margin = STATE_MARGIN * (high - low)
        edge = 0.0
        if corridor:
            edge = corridor["corridor_m"] + ALLOWANCE * _sensors(corridor)[LATERAL]
        margin[LATERAL] = 0.0
        low, high = low - margin, high + margin
        low[LATERAL] = min(low[LATERAL], -edge)
        high[LATERAL] = max(high[LATERAL], edge)
        env, road = boxes["env"], np.asarray(boxes["control"], float)[:, 2:]
        # [2:] are κ and v_ref; ν has its limits in the law.
        road = road + ROAD_MARGIN * np.abs(road) * np.asarray([[-1.0], [1.0]])
        return control.Conditions(
            env=_box(*env), state=_box(low, high), road=_box(*road)
        )
    # Without a certificate nothing says where a model predicts.
    env = None if env_low is None or env_high is None else _box(env_low, env_high)
    return control.Conditions(env=env)


def _box(low: Any, high: Any) -> control.Box:
    """Limits as plain numbers."""
    return tuple(map(float, low)), tuple(map(float, high))
