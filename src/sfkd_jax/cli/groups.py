"""The schemas of all groups of options."""

from __future__ import annotations

from functools import cache
from typing import Any

from hydra.core.config_store import ConfigStore

from sfkd_jax import (
    build,
    control,
    evaluation,
    scenarios,
    training,
)
from sfkd_jax import (
    data as datasets,
)
from sfkd_jax import (
    export as exporting,
)
from sfkd_jax.certification import issue
from sfkd_jax.cli import settings
from sfkd_jax.cli.schemas import schema
from sfkd_jax.corridor import certify_corridor

_BY_PLANT = (
    "dt",
    "wheelbase",
    "speed_loop",
    "control_low",
    "control_high",
    "env_low",
    "env_high",
    "sharding",
    "unroll",
    "actuator",
)
"""Arguments of controllers that the vehicle, the data set and the machine decide."""
_CHANNELS = {"noise_std": 2, "control_rate": 2}
"""One entry for each of the two controls."""


@cache
def root_schema() -> type:
    """Return the schema of the settings that belong to no group."""
    return schema(
        "RootConfig",
        settings.Root,
        demo=schema("DemoConfig", settings.Demo),
        report=schema("ReportConfig", settings.Report),
    )


@cache
def schemas() -> dict[str, dict[str, type]]:
    """Return the schemas of every group by their names in Hydra's store."""
    return {
        "vehicle": _vehicles(),
        "scenario": _scenarios(),
        "dataset": _datasets(),
        "model": _models(),
        "controller": _controllers(),
        "training": _trainings(),
        "certification": _certifications(),
        "evaluation": _evaluations(),
        "comparison": {"schema": schema("ComparisonConfig", settings.Comparison)},
        "export": _exports(),
    }


def register() -> None:
    """Put the schemas into Hydra's store."""
    for group, nodes in schemas().items():
        for name, node in nodes.items():
            ConfigStore.instance().store(group=group, name=name, node=node)


def _vehicles() -> dict[str, type]:
    return {
        f"{name}_schema": schema(
            "VehicleConfig", settings.Loop, settings.OwnStep, plant
        )
        if name == "own"
        else schema(
            "VehicleConfig", settings.Loop, plant, skip=("stiffness_by_friction",)
        )
        for name, plant in build.PLANTS.items()
    }


def _scenarios() -> dict[str, type]:
    given = ("state_size", "dt", "duration")
    return {"schema": schema("ScenarioConfig", scenarios.scenario, skip=given)}


def _datasets() -> dict[str, type]:
    given = ("coordinates", "env_low", "env_high")
    law = schema("LawConfig", control.derive_path_law, skip=given)
    from_plant = ("dt", "wheelbase", "limits", "needs_environment", "report")
    columns = schema("ColumnsConfig", datasets.Columns)
    return {
        "schema": schema("DatasetConfig", settings.Split, datasets.generate),
        "path_schema": schema(
            "PathDatasetConfig", settings.Split, datasets.generate_along_path, law=law
        ),
        "files_schema": schema(
            "LogsConfig",
            settings.Logs,
            datasets.from_logs,
            skip=from_plant,
            columns=columns,
        ),
    }


def _models() -> dict[str, type]:
    given = ("dt", "nominal")
    return {
        f"{name}_schema": schema("ModelConfig", settings.Named, factory, skip=given)
        for name, factory in build.MODELS.items()
    }


def _controllers() -> dict[str, type]:
    """One schema a planner: its own settings, and those of what is built around it."""
    cost = schema("CostConfig", control.tracking_cost, skip=_BY_PLANT)
    along_path = {
        "adaptation": schema(
            "AdaptationConfig",
            control.adaptive,
            skip=(*_BY_PLANT, "coordinates", "estimate_env"),
        ),
        "online_tube": schema(
            "OnlineTubeConfig", control.online_tube, skip=("horizon",)
        ),
    }
    nodes = {}
    for name, planner in build.PLANNERS.items():
        own = schema(
            "PlannerConfig",
            *planner.factories,
            skip=(*_BY_PLANT, *planner.given),
            entries=_CHANNELS,
        )
        parts: dict[str, Any] = {
            "cost": cost,
            name: own,
            "task": _task(planner.samples),
        }
        sources: tuple[Any, ...] = (settings.Chosen,)
        if planner.samples:
            sources = (settings.Chosen, settings.Sampling)
            parts |= _laws() | along_path
        nodes[f"{name}_schema"] = schema("ControllerConfig", *sources, **parts)
    return nodes


def _task(samples: bool) -> type:
    """Return the schema of the task; a quadratic program has its terminal weight."""
    unused = () if samples else ("control_rate", "latent_weight")
    return schema(
        "TaskConfig",
        control.path_tracking,
        skip=(*_BY_PLANT, "ancillary", *unused),
        entries=_CHANNELS,
    )


def _laws() -> dict[str, type]:
    """Settings of the laws that a planner can sample around."""
    return {
        "feedback": schema("FeedbackConfig", control.path_feedback, skip=_BY_PLANT),
        "model_law": schema("ModelLawConfig", control.ModelLaw, skip=("dt",)),
    }


def _trainings() -> dict[str, type]:
    loss = schema("LossConfig", training.multi_step_loss)
    sources = (settings.Batches, training.fit)
    common: dict[str, Any] = {"skip": ("inspect",), "loss": loss}
    return {
        "schema": schema("TrainingConfig", *sources, **common),
        "started_schema": schema("TrainingConfig", settings.Start, *sources, **common),
    }


def _certifications() -> dict[str, type]:
    measured = (
        "validation",
        "calibration",
        "held_out",
        "boxes",
        "drives",
        "sensor_noise",
    )
    given = ("settings", "trained", "outputs")
    corridor = schema("CorridorConfig", certify_corridor, skip=given)
    node = schema(
        "CertificationConfig", settings.Renewal, issue, skip=measured, corridor=corridor
    )
    return {"schema": node}


def _evaluations() -> dict[str, type]:
    sensor = schema("EnvSensorConfig", evaluation.observed_environment, skip=("dt",))
    return {"schema": schema("EvaluationConfig", settings.Protocol, env_sensor=sensor)}


def _exports() -> dict[str, type]:
    node = schema("ExportConfig", exporting.write_controller, skip=("made_from",))
    return {"schema": node}
