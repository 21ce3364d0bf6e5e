"""The vocabulary as Hydra knows it: schemas derived from the signatures of factories."""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable
from dataclasses import field, make_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore

from sfkd_jax import (
    build,
    control,
    datasets,
    evaluation,
    exporting,
    models,
    scenarios,
    training,
)
from sfkd_jax.certification import issue
from sfkd_jax.corridor import certify_corridor

_SYSTEMS = ("self", "nominal", "oracle")
_SENSORS = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
"""Standard deviations of p_x, p_y [m], yaw [rad], v, v_y [m/s], yaw rate [rad/s],
steering [rad]: a satellite and inertial unit of survey grade.
"""
_THRESHOLD = 1.0
"""δ* of V2 [m]: a round number below 1.15 m, the nominal model's 95 % error within 2 s
on S1 (experiments/tracking).
"""


def schema(
    title: str,
    /,
    *factories: Callable[..., Any],
    skip: tuple[str, ...] = (),
    **extra: Any,
) -> type:
    """A dataclass with the keyword-only settings of factories: their types and defaults live once, in Python.

    Args:
        title: of the dataclass.
        factories: whose settings; of a name that several have, the first counts.
        skip: settings that something else decides.
        extra: further fields by default value, or by type if required.
    """
    fields: list[Any] = [_extra(key, value) for key, value in extra.items()]
    for factory in factories:
        hints = typing.get_type_hints(factory)
        for parameter in inspect.signature(factory).parameters.values():
            known = parameter.name in skip or parameter.name in {
                name for name, *_ in fields
            }
            if parameter.kind is not parameter.KEYWORD_ONLY or known:
                continue
            if parameter.default is parameter.empty:
                fields.append((parameter.name, _plain(hints[parameter.name])))
                continue
            fields.append(
                _field(parameter.name, hints[parameter.name], parameter.default)
            )
    required_first = sorted(fields, key=lambda entry: len(entry) > 2)
    return make_dataclass(title, required_first)


def _extra(name: str, value: Any) -> tuple[Any, ...]:
    """A field by its type (required) or by its default."""
    if isinstance(value, type):
        return (
            (name, value)
            if not dataclasses.is_dataclass(value)
            else (name, value, field(default_factory=value))
        )
    if value is None:
        return name, typing.Any, field(default=None)
    if typing.get_origin(value):
        return name, value
    return _field(
        name,
        tuple[type(next(iter(value), 0.0)), ...]
        if isinstance(value, tuple)
        else type(value),
        value,
    )


def _field(name: str, hint: Any, default: Any) -> tuple[str, Any, Any]:
    """A dataclass field with a default; sequences become lists, as YAML has them."""
    if isinstance(default, tuple):
        values = list(default)
        return name, _plain(hint), field(default_factory=lambda: list(values))
    return name, _plain(hint), field(default=default)


def _plain(hint: Any) -> Any:
    """Types as OmegaConf knows them: tuple[float, ...] becomes list[float]."""
    if typing.get_origin(hint) is tuple:
        return list[typing.get_args(hint)[0]]
    if typing.get_origin(hint) is types.UnionType:
        return typing.Any
    return hint


def register() -> None:
    """Put every schema into Hydra's store."""
    store = ConfigStore.instance()
    loop = {"name": str, "inner_loop": "none", "speed_gain": 1.0}
    for name, plant in build.PLANTS.items():
        store.store(
            group="vehicle",
            name=f"{name}_schema",
            node=schema("VehicleConfig", plant, **loop),
        )
    fixed = ("state_size", "dt", "duration")
    store.store(
        group="scenario",
        name="schema",
        node=schema("ScenarioConfig", scenarios.scenario, skip=fixed),
    )
    split = {
        "seed": 0,
        "shares": list[float],
        "env_low": list[float],
        "env_high": list[float],
    }
    store.store(
        group="dataset",
        name="schema",
        node=schema("DatasetConfig", datasets.generate, **split),
    )
    boxed = ("coordinates", "env_low", "env_high")
    law = {"law": schema("LawConfig", control.derive_path_law, skip=boxed)}
    node = schema(
        "PathDatasetConfig", datasets.generate_along_path, skip=boxed, **split, **law
    )
    store.store(group="dataset", name="path_schema", node=node)
    logs = {
        "path": str,
        "columns": schema("ColumnsConfig", **datasets.Columns._field_defaults),
    }
    node = schema(
        "LogsConfig",
        datasets.from_logs,
        skip=("dt", "wheelbase", "limits", "told", "say"),
        **logs,
    )
    store.store(group="dataset", name="files_schema", node=node)
    for name, factory in models.FACTORIES.items():
        node = schema(
            "ModelConfig", factory, skip=("dt", "nominal"), name=str, system=str
        )
        store.store(group="model", name=f"{name}_schema", node=node)
    store.store(group="controller", name="mppi_schema", node=_controller_schema())
    loss = schema("LossConfig", training.multi_step_loss)
    for name, start in {"schema": {}, "started_schema": {"start": "random"}}.items():
        options = schema(
            "Fit",
            training.fit,
            skip=("inspect",),
            batch=128,
            window=20,
            data_share=1.0,
            **start,
        )
        node = make_dataclass(
            "TrainingConfig",
            [("loss", loss, field(default_factory=loss)), *_fields(options)],
        )
        store.store(group="training", name=name, node=node)
    protocol = {
        "episodes": 8,
        "episode_s": 60.0,
        "seed": 2026,
        "systems": _SYSTEMS,
        "observation_noise": _SENSORS,
    }
    protocol |= {
        "timed_steps": 50,
        "side_forces": (),
        "threshold_m": _THRESHOLD,
        "variation": None,
    }
    sensor = schema("EnvSensorConfig", evaluation.observed_environment, skip=("dt",))
    protocol |= {"env_sensor": sensor}
    store.store(
        group="evaluation", name="schema", node=schema("EvaluationConfig", **protocol)
    )
    measured = (
        "validation",
        "calibration",
        "held_out",
        "boxes",
        "drives",
        "sensor_noise",
    )
    corridor = schema(
        "CorridorConfig", certify_corridor, skip=("settings", "trained", "outputs")
    )
    node = schema(
        "CertificationConfig", issue, skip=measured, renew=False, corridor=corridor
    )
    store.store(group="certification", name="schema", node=node)
    words = {
        "policies": str,
        "vehicles": list[str],
        "seeds": list[int],
        "only": list[str],
        "drive": True,
        "older": False,
    }
    words |= {name: dict[str, Any] for name in ("rows", "variations", "paper")}
    words |= {
        "controllers": dict[str, list[str]],
        "own_controllers": dict[str, dict[str, Any]],
    }
    store.store(
        group="comparison",
        name="schema",
        node=schema("ComparisonConfig", **words, share=None),
    )
    node = schema("ExportConfig", exporting.write_controller, skip=("made_from",))
    store.store(group="export", name="schema", node=node)


def _fields(node: type) -> list[Any]:
    """The fields of a dataclass, to be part of another."""
    return [
        (entry.name, entry.type, field(default=entry.default))
        for entry in dataclasses.fields(node)
    ]


def _controller_schema() -> type:
    """Settings of the planners, their task, cost and law, less what the vehicle and the machine decide."""
    fixed = (
        "dt",
        "wheelbase",
        "speed_loop",
        "control_low",
        "control_high",
        "env_low",
        "env_high",
    )
    placed, weighted = (
        (*fixed, "sharding", "actuator"),
        ("effective_samples", "temperature"),
    )
    parts = {
        "mppi": schema("MppiConfig", control.mppi, control.planner, skip=placed),
        "cem": schema(
            "CemConfig", control.cem, control.planner, skip=(*placed, *weighted)
        ),
        "gradient": schema(
            "GradientConfig",
            control.gradient_planner,
            control.planner,
            skip=(*placed, *weighted),
        ),
        "task": schema(
            "TaskConfig", control.path_tracking, skip=(*placed, "ancillary")
        ),
        "cost": schema("CostConfig", control.tracking_cost, skip=fixed),
        "feedback": schema("FeedbackConfig", control.path_feedback, skip=fixed),
        "model_law": schema("ModelLawConfig", **control.ModelLaw._field_defaults),
    }
    shared = (
        "lateral",
        "course",
        "speed",
        "steering_rate",
        "effort",
        "terminal_weight",
    )
    parts["koopman_mpc"] = schema(
        "KoopmanMpcConfig", control.koopman_mpc, skip=(*fixed, *shared)
    )
    watched = ("bounds", "state_low", "state_high", *fixed)
    parts["estimator"] = schema(
        "EstimatorConfig", control.estimated, skip=(*fixed, "states", "controls")
    )
    parts["monitor"] = schema("MonitorConfig", control.monitored, skip=watched)
    fields = [(name, part, field(default_factory=part)) for name, part in parts.items()]
    head = [
        ("name", str),
        ("planner", str),
        ("sampling", typing.Any),
        ("ancillary", bool, field(default=False)),
    ]
    head.append(("shield", bool, field(default=False)))
    return make_dataclass("ControllerConfig", [*head, *fields])
