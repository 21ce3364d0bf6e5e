"""The schemas of all groups of options, and the settings that belong to no factory."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, NamedTuple

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
from sfkd_jax.cli.schemas import BelowRoot, FileNames, schema
from sfkd_jax.core.ranges import (
    Entries,
    Fraction,
    Interval,
    Names,
    NonNegativeInt,
    Numbers,
    Positive,
    PositiveFraction,
    Real,
)
from sfkd_jax.corridor import certify_corridor

_Directory = Annotated[str, BelowRoot()]
_Overrides = Annotated[dict[str, str | None], FileNames()]
_Seconds = Annotated[float, Interval("(2, inf)")]
"""Of an episode; the first two seconds are not scored."""
_BY_PLANT = (
    "dt",
    "wheelbase",
    "speed_loop",
    "control_low",
    "control_high",
    "env_low",
    "env_high",
    "sharding",
    "actuator",
)
"""Arguments of controllers that the vehicle, the data set and the machine decide."""
_CHANNELS = {"noise_std": 2, "control_rate": 2}
"""One entry for each of the two controls."""


class Demo(NamedTuple):
    """Episodes of `demo`."""

    episodes: int
    episode_s: _Seconds
    timed_steps: NonNegativeInt


class Report(NamedTuple):
    """What `report` compares."""

    compare: str | None


class Root(NamedTuple):
    """Settings of no group."""

    seed: NonNegativeInt
    name: _Directory
    root: str
    env_source: str


class Loop(NamedTuple):
    """The vehicle's name and its inner loop."""

    name: str
    inner_loop: str = "none"
    speed_gain: Positive = 1.0


class OwnStep(NamedTuple):
    """The step of an own vehicle, as package.module:function."""

    step: str | None = None


class Split(NamedTuple):
    """How a data set is split, and its environment box E."""

    shares: tuple[Fraction, Fraction, Fraction, Fraction]
    env_low: tuple[Real, ...]
    env_high: tuple[Real, ...]
    seed: NonNegativeInt = 0


class Logs(NamedTuple):
    """Where log files are."""

    path: str


class Named(NamedTuple):
    """The factory of a model, and the name of its runs and rows."""

    name: str
    system: _Directory


class Batches(NamedTuple):
    """The data of a training step."""

    batch: int = 128
    window: int = 20
    data_share: PositiveFraction = 1.0


class Start(NamedTuple):
    """The initial weights of training."""

    start: str = "random"


class Protocol(NamedTuple):
    """Episodes, systems and sensors of the closed loop.

    Attributes:
        episodes: per system.
        episode_s: [s].
        seed: of roads, environments, sensor noise and samplers.
        systems: "self" and reference systems.
        observation_noise: standard deviations of p_x, p_y [m], yaw [rad], v, v_y [m/s],
            yaw rate [rad/s], steering [rad]; by default of a satellite and inertial
            unit of survey grade.
        timed_steps: control steps whose time is measured.
        side_forces: side forces that no model knows [N].
        threshold_m: δ* of V2 [m]: a round number below 1.15 m, the nominal model's 95 %
            error within 2 s on S1 (experiments/tracking).
        variation: name of a variation of the protocol.
    """

    episodes: int = 8
    episode_s: _Seconds = 60.0
    seed: NonNegativeInt = 2026
    systems: tuple[str, ...] = ("self", "nominal", "oracle")
    observation_noise: Numbers = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
    timed_steps: NonNegativeInt = 50
    side_forces: Numbers = ()
    threshold_m: Positive = 1.0
    variation: str | None = None


class Renewal(NamedTuple):
    """Whether `certify` replaces a certificate of other weights."""

    renew: bool = False


class Comparison(NamedTuple):
    """The rows and columns of `compare`; conf/comparison/none.yaml explains each."""

    policies: _Directory
    vehicles: Names
    seeds: Annotated[tuple[NonNegativeInt, ...], Entries(least=0)]
    only: Names
    rows: _Overrides
    variations: _Overrides
    paper: dict[str, Any]
    page: dict[str, Any]
    controllers: dict[str, Names]
    own_controllers: Annotated[dict[str, dict[str, str | None]], FileNames()]
    drive: bool = True
    older: bool = False
    share: tuple[NonNegativeInt, NonNegativeInt] | None = None


class Chosen(NamedTuple):
    """The planner of a controller, and the law that it samples around."""

    name: str
    planner: str
    sampling: str | None


class Sampling(NamedTuple):
    """Switches of a planner that samples around a law."""

    ancillary: bool = False
    shield: bool = False


@cache
def root_schema() -> type:
    """Return the schema of the settings that belong to no group."""
    return schema(
        "RootConfig",
        Root,
        demo=schema("DemoConfig", Demo),
        report=schema("ReportConfig", Report),
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
        "comparison": {"schema": schema("ComparisonConfig", Comparison)},
        "export": _exports(),
    }


def register() -> None:
    """Put the schemas into Hydra's store."""
    for group, nodes in schemas().items():
        for name, node in nodes.items():
            ConfigStore.instance().store(group=group, name=name, node=node)


def _vehicles() -> dict[str, type]:
    return {
        f"{name}_schema": schema("VehicleConfig", Loop, OwnStep, plant)
        if name == "own"
        else schema("VehicleConfig", Loop, plant)
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
        "schema": schema("DatasetConfig", Split, datasets.generate),
        "path_schema": schema(
            "PathDatasetConfig", Split, datasets.generate_along_path, law=law
        ),
        "files_schema": schema(
            "LogsConfig", Logs, datasets.from_logs, skip=from_plant, columns=columns
        ),
    }


def _models() -> dict[str, type]:
    given = ("dt", "nominal")
    return {
        f"{name}_schema": schema("ModelConfig", Named, factory, skip=given)
        for name, factory in models.FACTORIES.items()
    }


def _controllers() -> dict[str, type]:
    """One schema a planner: its own settings, and those of what is built around it."""
    wrappers = {
        "estimator": schema(
            "EstimatorConfig",
            control.estimated,
            skip=(*_BY_PLANT, "states", "controls"),
        ),
        "monitor": schema(
            "MonitorConfig",
            control.monitored,
            skip=(*_BY_PLANT, "bounds", "state_low", "state_high"),
        ),
    }
    wrappers["cost"] = schema("CostConfig", control.tracking_cost, skip=_BY_PLANT)
    nodes = {}
    for name, planner in build.PLANNERS.items():
        own = schema(
            "PlannerConfig",
            *planner.factories,
            skip=(*_BY_PLANT, *planner.given),
            entries=_CHANNELS,
        )
        parts = wrappers | {name: own, "task": _task(planner.samples)}
        sources: tuple[Any, ...] = (Chosen,)
        if planner.samples:
            sources, parts = (Chosen, Sampling), parts | _laws()
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
    sources = (Batches, training.fit)
    common: dict[str, Any] = {"skip": ("inspect",), "loss": loss}
    return {
        "schema": schema("TrainingConfig", *sources, **common),
        "started_schema": schema("TrainingConfig", Start, *sources, **common),
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
        "CertificationConfig", Renewal, issue, skip=measured, corridor=corridor
    )
    return {"schema": node}


def _evaluations() -> dict[str, type]:
    sensor = schema("EnvSensorConfig", evaluation.observed_environment, skip=("dt",))
    return {"schema": schema("EvaluationConfig", Protocol, env_sensor=sensor)}


def _exports() -> dict[str, type]:
    node = schema("ExportConfig", exporting.write_controller, skip=("made_from",))
    return {"schema": node}
