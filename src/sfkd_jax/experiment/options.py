"""The settings of a run: one dataclass a group, and their schemas for Hydra."""

from __future__ import annotations

import typing
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from typing import Annotated, Any

from sfkd_jax import build, data, evaluation, export, training
from sfkd_jax.build import (
    ControllerSettings,
    Directory,
    LawSettings,
    ModelSettings,
    ScenarioSettings,
    VehicleSettings,
)
from sfkd_jax.certification import issue
from sfkd_jax.certification.corridor import certify_corridor
from sfkd_jax.ranges import (
    Bounds,
    Entries,
    Fraction,
    Interval,
    Names,
    NonNegativeInt,
    Numbers,
    Positive,
    PositiveFraction,
)
from sfkd_jax.settings import (
    FileNames,
    Kinds,
    Values,
    hints_of,
    parse,
    plain,
    replace,
    schema,
)

Overrides = Annotated[dict[str, str | None], FileNames()]
Seconds = Annotated[float, Interval("(2, inf)")]
"""Of an episode; the first two seconds are not scored."""


@dataclass(frozen=True, kw_only=True)
class EnvironmentSettings(Kinds):
    """What surrounds the vehicle: e in its box, and how a controller learns of it.

    Attributes:
        low: lower corner of the box E; None for that of recorded logs.
        high: upper corner of E.
        source: "measured", "estimated" while driving, or "none": e is not observed.
        sensor: delay, noise and bias of a measured e.
    """

    low: Bounds | None = None
    high: Bounds | None = None
    source: str = "measured"
    sensor: Any = None

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the one dataclass."""
        return _ENVIRONMENT

    @property
    def box(self) -> dict[str, tuple[float, ...] | None]:
        """The corners of E, as arguments of factories."""
        return {"env_low": self.low, "env_high": self.high}


@dataclass(frozen=True, kw_only=True)
class DatasetSettings(Kinds):
    """Where the data come from, and how they are split.

    Attributes:
        shares: of training, validation, calibration and test.
        seed: of simulation and split.
        steps: of a segment.
    """

    shares: tuple[Fraction, Fraction, Fraction, Fraction]
    seed: NonNegativeInt = 0
    steps: int = 50

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the dataclass of logs, of path coordinates or of the world."""
        if "path" in values:
            return _DATASETS["files_schema"]
        return _DATASETS["path_schema" if "law" in values else "schema"]


@dataclass(frozen=True, kw_only=True)
class SimulatedSettings(DatasetSettings):
    """Simulated data; the other fields are arguments of the generator."""

    segments: Annotated[int, Interval("[4, inf)")] = 8000


@dataclass(frozen=True, kw_only=True)
class AlongPathSettings(SimulatedSettings):
    """Simulated data in path coordinates, around a law."""

    law: LawSettings = None  # pyright: ignore


@dataclass(frozen=True, kw_only=True)
class LogSettings(DatasetSettings):
    """Recorded logs; the other fields are arguments of `data.from_logs`."""

    path: str
    columns: Any = None


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(Kinds):
    """How a model is trained; the other fields are arguments of `training.fit`.

    Attributes:
        batch: windows a step.
        window: steps of a window.
        data_share: part of the training trajectories that is used.
        loss: weights of `training.multi_step_loss`.
    """

    batch: int = 128
    window: int = 20
    data_share: PositiveFraction = 1.0
    steps: int = 4000
    loss: Any = None

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the one dataclass."""
        return _TRAINING


@dataclass(frozen=True, kw_only=True)
class CertificationSettings(Kinds):
    """What is proved and measured; the other fields are arguments of `issue`.

    Attributes:
        renew: whether `certify` replaces a certificate of other weights.
        horizon: of the tubes [steps].
        level: of the tubes.
        corridor: arguments of `certify_corridor`.
    """

    renew: bool = False
    horizon: int = 20
    level: Fraction = 0.95
    corridor: Any = None

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the one dataclass."""
        return _CERTIFICATION


@dataclass(frozen=True, kw_only=True)
class EvaluationSettings:
    """Episodes, systems and sensors of the closed loop.

    Attributes:
        episodes: per system.
        episode_s: [s].
        seed: of roads, environments, sensor noise and samplers.
        systems: "self" and reference systems; none: `train` trains alone.
        observation_noise: standard deviations of p_x, p_y [m], yaw [rad], v, v_y [m/s],
            yaw rate [rad/s], steering [rad]; by default of a satellite and inertial
            unit of survey grade.
        timed_steps: control steps whose time is measured.
        side_forces: side forces that no model knows [N].
        threshold_m: δ* of V2 [m]: a round number below 1.15 m, the nominal model's 95 %
            error within 2 s on S1.
        variation: name of a variation of the protocol.
    """

    episodes: int = 8
    episode_s: Seconds = 60.0
    seed: NonNegativeInt = 2026
    systems: Annotated[tuple[str, ...], Entries(least=0)] = (
        "self",
        "nominal",
        "oracle",
    )
    observation_noise: Numbers = (0.015, 0.015, 0.002, 0.03, 0.02, 0.002, 0.001)
    timed_steps: NonNegativeInt = 50
    side_forces: Numbers = ()
    threshold_m: Positive = 1.0
    variation: str | None = None


@dataclass(frozen=True, kw_only=True)
class ComparisonSettings:
    """The rows and columns of `compare`; conf/comparison/none.yaml explains each."""

    policies: Directory
    vehicles: Names
    seeds: Annotated[tuple[NonNegativeInt, ...], Entries(least=0)]
    only: Names
    untrained: Names
    trained_once: Names
    rows: Overrides
    tuned: dict[str, dict[str, str]]
    variations: Overrides
    paper: dict[str, Any]
    page: dict[str, Any]
    controllers: dict[str, Names]
    own_controllers: Annotated[dict[str, dict[str, str | None]], FileNames()]
    drive: bool = True
    share: tuple[NonNegativeInt, NonNegativeInt] | None = None


@dataclass(frozen=True, kw_only=True)
class ExportSettings(Kinds):
    """Arguments of `export.write_controller`."""

    @classmethod
    def kind_of(cls, values: Values) -> type:
        """Return the one dataclass."""
        return _EXPORT


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """Episodes of `demo`."""

    episodes: int
    episode_s: Seconds
    timed_steps: NonNegativeInt


@dataclass(frozen=True, kw_only=True)
class ReportSettings:
    """What `report` compares: a pattern of run directories, or None."""

    compare: str | None


@dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings of a command.

    Attributes:
        seed: of the initial weights and the training windows.
        name: of the run.
        root: directory of all artefacts.
        optimized: whether programs are compiled well; if not, fast, for trials.
    """

    seed: NonNegativeInt
    name: Directory
    root: str
    optimized: bool
    vehicle: VehicleSettings
    environment: EnvironmentSettings
    scenario: ScenarioSettings
    dataset: DatasetSettings
    model: ModelSettings
    controller: ControllerSettings
    training: TrainingSettings
    certification: CertificationSettings
    evaluation: EvaluationSettings
    comparison: ComparisonSettings
    export: ExportSettings
    demo: DemoSettings
    report: ReportSettings

    @property
    def run_dir(self) -> Path:
        """The directory of the run, root/name/system/seed=N."""
        return Path(self.root) / self.name / self.model.system / f"seed={self.seed}"


def parse_settings(values: Values) -> Settings:
    """Return checked settings; with `environment.source=none` the model reads no e.

    Raises:
        ValueError: a setting that does not exist or is out of its range, an unknown
            source, or an estimate of an environment that the model does not read.
    """
    settings = parse(Settings, values)
    source = settings.environment.source
    if source not in build.ENV_SOURCES:
        raise ValueError(
            f"unknown environment.source {source!r}; "
            f"choose one of {', '.join(build.ENV_SOURCES)}"
        )
    reads = settings.model.environment
    if source == "estimated" and not reads:
        raise ValueError(
            "environment.source=estimated needs a model that reads the environment; "
            "drop model.environment=false"
        )
    model = replace(settings.model, environment=reads and source != "none")
    return replace(settings, model=model)


_ENVIRONMENT: type = schema(
    "Environment",
    EnvironmentSettings,
    sensor=schema("Sensor", None, evaluation.observed_environment, skip=("dt",)),
)
_BOX = ("env_low", "env_high")
_LOGGED = ("dt", "wheelbase", "limits", "needs_environment", "report", *_BOX)
_DATASETS: dict[str, type] = {
    "schema": schema("Dataset", SimulatedSettings, data.generate),
    "path_schema": schema(
        "PathDataset",
        AlongPathSettings,
        data.generate_along_path,
        skip=_BOX,
        law=LawSettings.kind_of({}),
    ),
    "files_schema": schema(
        "Logs",
        LogSettings,
        data.from_logs,
        skip=_LOGGED,
        columns=schema("Columns", None, data.Columns),
    ),
}
_TRAINING: type = schema(
    "Training",
    TrainingSettings,
    training.fit,
    skip=("inspect",),
    loss=schema("Loss", None, training.multi_step_loss),
)
_MEASURED = (
    "validation",
    "calibration",
    "held_out",
    "boxes",
    "runs",
)
_CERTIFICATION: type = schema(
    "Certification",
    CertificationSettings,
    issue,
    skip=_MEASURED,
    corridor=schema("Corridor", None, certify_corridor),
)
_EXPORT: type = schema(
    "Export", ExportSettings, export.write_controller, skip=("made_from",)
)


def hydra_schemas() -> dict[str, dict[str, type]]:
    """Return the schemas of every group by their names in Hydra's store."""
    kinds: dict[str, dict[str, type]] = {
        "vehicle": {f"{name}_schema": kind for name, kind in build.VEHICLES.items()},
        "environment": {"schema": _ENVIRONMENT},
        "scenario": {"schema": build.SCENARIO},
        "dataset": _DATASETS,
        "model": {
            f"{name}_schema": kind for name, kind in build.MODEL_SETTINGS.items()
        },
        "controller": {
            f"{name}_schema": kind for name, kind in build.CONTROLLER_SETTINGS.items()
        },
        "training": {"schema": _TRAINING},
        "certification": {"schema": _CERTIFICATION},
        "evaluation": {"schema": EvaluationSettings},
        "comparison": {"schema": ComparisonSettings},
        "export": {"schema": _EXPORT},
    }
    return {
        group: {name: _for_hydra(kind) for name, kind in nodes.items()}
        for group, nodes in kinds.items()
    }


def _for_hydra(kind: type) -> type:
    """Return a dataclass of the types that OmegaConf knows; what is unset is ???."""
    declared, entries = hints_of(kind), []
    for entry in fields(typing.cast(Any, kind)):
        hint, default = declared[entry.name], entry.default
        if entry.default_factory is not MISSING:
            default = entry.default_factory()
        if is_dataclass(default):  # a group inside the group
            inner = _for_hydra(type(default))
            about: Any = field(default_factory=inner)
            hint = inner
        elif default is MISSING:
            hint, about = _plain_type(hint), field(default="???")
        else:
            value = plain(default)
            about = field(default_factory=lambda value=value: value)
            hint = _plain_type(hint)
        entries.append((entry.name, hint, about))
    return make_dataclass(kind.__name__, entries)


def _plain_type(hint: Any) -> Any:
    """Return a type that OmegaConf knows: tuple[float, ...] becomes list[float]."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is typing.Annotated:
        return _plain_type(parts[0])
    if origin is tuple:
        return list[_plain_type(parts[0])]
    if origin is dict:
        return dict[str, _plain_type(parts[1])]
    simple = hint in (bool, int, float, str) or hint is Any
    return hint if simple else Any
