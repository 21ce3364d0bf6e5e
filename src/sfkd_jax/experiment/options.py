"""The settings of a run: one dataclass a group, which Hydra takes as its schemas."""

from __future__ import annotations

import os
from dataclasses import field, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

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
from sfkd_jax.plants import KNOWN_STATES, Vehicle, described
from sfkd_jax.policy import CERTIFICATE
from sfkd_jax.ranges import (
    Bounds,
    Fraction,
    Interval,
    MayBeEmpty,
    Names,
    NonNegative,
    NonNegativeInt,
    Numbers,
)
from sfkd_jax.scenarios import DriveClass
from sfkd_jax.settings import OneOf, Values, arguments, parse, replace, schema, takes

Overrides = dict[str, str | None]
Seconds = Annotated[float, Interval("(2, inf)")]
"""Of an episode; the first two seconds are not scored."""
empty: Any = partial(field, default_factory=dict)
_BOX = ("env_low", "env_high")


@takes(sensor=schema("Sensor", object, evaluation.observed_environment, skip=("dt",)))
class EnvironmentSettings:
    """What surrounds the vehicle: e in its box, and how a controller learns of it.

    Attributes:
        low: lower corner of the box E; None for that of recorded logs.
        high: upper corner of E.
        names: of the entries of e, with units; () for friction and lateral wind.
        source: "measured", "estimated" while driving, or "none": e is not observed.
        sensor: delay, noise and bias of a measured e.
    """

    sensor: Any
    low: Bounds | None = None
    high: Bounds | None = None
    names: Names = ()
    source: Annotated[str, OneOf(build.ENV_SOURCES)] = "measured"

    @property
    def box(self) -> dict[str, Any]:
        """The corners of E, as arguments of factories."""
        return {"env_low": self.low, "env_high": self.high}

    @property
    def is_known(self) -> bool:
        """Whether e is measured or estimated."""
        return self.source != "none"


@takes()
class DatasetSettings:
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
    def subclass_for(cls, values: Values) -> type[DatasetSettings]:
        """Return the dataclass of logs, of path coordinates or of the world."""
        if "path" in values:
            return LogSettings
        return AlongPathSettings if "law" in values else SimulatedSettings


@takes(data.generate, skip=("held_out", *_BOX))
class SimulatedSettings(DatasetSettings):
    """Simulated data; the other fields are arguments of the generator."""


@takes(
    data.generate_along_path,
    DriveClass,
    skip=("limits", "held_out", *_BOX),
    law=LawSettings,
)
class AlongPathSettings(DatasetSettings):
    """Simulated data in path coordinates, around a law.

    Its drives are of a class, whose fields are settings too.
    """

    law: LawSettings

    @property
    def options(self) -> dict[str, Any]:
        """Return the arguments of the generator."""
        drives = DriveClass(**arguments(self, DriveClass))
        return arguments(self, data.generate_along_path) | {"limits": drives}


@build.takes_logs
class LogSettings(DatasetSettings):
    """Recorded logs; the other fields are arguments of `data.from_logs`."""

    path: str
    columns: Any


@takes(
    training.fit,
    skip=("inspect",),
    loss=schema("Loss", object, training.multi_step_loss),
)
class TrainingSettings:
    """How a model is trained; the other fields are arguments of `training.fit`.

    Attributes:
        batch: windows a step.
        window: steps of a window.
    """

    loss: Any
    batch: int = 128
    window: int = 20
    steps: int = 4000


@takes(
    issue,
    skip=("validation", "calibration", "held_out", "boxes", "runs"),
    corridor=schema("Corridor", object, certify_corridor),
)
class CertificationSettings:
    """What is proved and measured; the other fields are arguments of `issue`.

    Attributes:
        renew: whether `certify` replaces a certificate of other weights.
        horizon: of the tubes [steps].
        level: of the tubes.
    """

    corridor: Any
    renew: bool = False
    horizon: int = 20
    level: Fraction = 0.95


@takes()
class EvaluationSettings:
    """Episodes, systems and sensors of the closed loop.

    Attributes:
        episodes: per system.
        episode_s: [s].
        seed: of roads, sensors and samplers.
        systems: "self" and reference systems; none: `train` trains alone.
        observation_noise: standard deviations by name of the state; None for that which
            the vehicle states, see `plants.KNOWN_STATES`. Other states are exact.
        side_forces: side forces that no model knows [N].
    """

    episodes: int = 8
    episode_s: Seconds = 60.0
    seed: NonNegativeInt = 2026
    systems: Names = ("self", "nominal", "oracle")
    observation_noise: dict[str, NonNegative | None] = field(
        default_factory=partial(dict.fromkeys, KNOWN_STATES)
    )
    side_forces: Numbers = ()


@takes()
class ComparisonSettings:
    """The rows and columns of `compare`.

    Attributes:
        policies: the name that trained rows have.
        vehicles: options of the group.
        seeds: of the trainings.
        controllers: controller -> scenarios.
        own_controllers: row -> controller -> what this row has instead, or None.
        rows: label -> overrides.
        one_seed: labels of rows of the first seed only, such as untrained ones.
        tuned: vehicle -> label -> more overrides.
        only: labels of rows; empty: all.
        share: [k, n]: evaluate every n-th row from the k-th on, collect nothing.
        paper: what the paper prints.
    """

    policies: Directory
    vehicles: Names = ()
    seeds: Annotated[tuple[NonNegativeInt, ...], MayBeEmpty()] = (0,)
    controllers: dict[str, Annotated[list[str], MayBeEmpty()]] = empty()
    own_controllers: dict[str, Overrides] = empty()
    rows: Overrides = empty()
    one_seed: Names = ()
    tuned: dict[str, dict[str, str]] = empty()
    only: Names = ()
    share: tuple[NonNegativeInt, NonNegativeInt] | None = None
    paper: dict[str, Any] = empty()


@takes(export.write_controller)
class ExportSettings:
    """Arguments of `export.write_controller`."""


@takes()
class DemoSettings:
    """Episodes of `demo`."""

    episodes: int
    episode_s: Seconds


@takes()
class CollectSettings:
    """The runs that `collect` reads.

    Attributes:
        path: a file, a folder or a glob.
    """

    path: str


@takes()
class Settings:
    """All settings of a command, see conf/config.yaml."""

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
    collect: CollectSettings

    @property
    def run_dir(self) -> Path:
        """The directory of the run, root/name/system/seed=N."""
        return Path(self.root) / self.name / self.model.system / f"seed={self.seed}"

    @property
    def policy_path(self) -> Path:
        """The policy of the run, whether or not it exists."""
        return self.run_dir / "policy.safetensors"

    @property
    def certificate_path(self) -> Path:
        """The certificate of the run, whether or not it exists."""
        return self.run_dir / CERTIFICATE

    def sensors(self, plant: Vehicle) -> tuple[float, ...]:
        """Return the standard deviations of the sensors of a vehicle, one a state."""
        noise = self.evaluation.observation_noise
        names = plant.state_names
        # Cars of one comparison may have different ones of the known states.
        if unknown := set(noise) - {*names, *KNOWN_STATES}:
            raise ValueError(
                f"evaluation.observation_noise names {', '.join(sorted(unknown))}, "
                f"the states of the vehicle are {', '.join(names)}"
            )
        asked = {name: value for name, value in noise.items() if value is not None}
        return tuple(asked.get(one.name, one.deviation) for one in plant.states)

    @property
    def logs(self) -> LogSettings | None:
        """The settings of logs; None if the data are simulated."""
        return self.dataset if isinstance(self.dataset, LogSettings) else None

    @property
    def along_path(self) -> AlongPathSettings | None:
        """The settings of path coordinates; None for those of the world."""
        return self.dataset if isinstance(self.dataset, AlongPathSettings) else None


def parse_settings(values: Values) -> Settings:
    """Return checked settings; with `environment.source=none` the model reads no e."""
    settings = parse(Settings, values)
    environment, reads = settings.environment, settings.model.environment
    if environment.source == "estimated" and not reads:
        raise ValueError(
            "environment.source=estimated needs a model that reads the environment; "
            "drop model.environment=false"
        )
    # Whoever estimates e follows a path, and tells apart what differs.
    constant = bool(environment.low) and environment.low == environment.high
    if environment.source == "estimated" and (settings.logs or constant):
        why = "logs train none" if settings.logs else f"e is always {environment.low}"
        raise ValueError(
            "environment.source=estimated needs a model in path coordinates and an "
            f"environment that varies: {why}; pass environment.source=measured or none"
        )
    model = replace(settings.model, environment=reads and environment.is_known)
    root, vehicle = str(Path(settings.root).expanduser()), settings.vehicle
    # Recorded with the run: whoever loads its policy need not have the simulator.
    if name := getattr(vehicle, "env", None):
        known, names = described(name)
        vehicle = replace(vehicle, **known)
        environment = replace(environment, names=environment.names or names)
    names, low = environment.names, environment.low or environment.names
    if names and len(names) != len(low):
        raise ValueError(
            f"environment.low and environment.high need {len(names)} entries, "
            f"for {', '.join(names)}"
        )
    about: dict[str, Any] = {"vehicle": vehicle, "environment": environment}
    return replace(settings, model=model, root=root, **about)


def register() -> None:
    """Put the dataclasses of all groups into Hydra's store, as schemas."""
    OmegaConf.register_new_resolver("home", os.path.expanduser, replace=True)
    datasets = {"": SimulatedSettings, "path": AlongPathSettings, "files": LogSettings}
    variants: dict[str, Any] = {
        "vehicle": build.VEHICLES,
        "model": build.MODEL_SETTINGS,
        "controller": build.CONTROLLER_SETTINGS,
        "dataset": datasets,
    }
    for group, hint in get_type_hints(Settings).items():
        # Of commands the primary config has the values itself.
        if not is_dataclass(hint) or group in ("demo", "collect"):
            continue
        for variant, kind in variants.get(group, {"": hint}).items():
            ConfigStore.instance().store(
                group=group,
                name=f"{variant}_schema".removeprefix("_"),
                node=_writable(OmegaConf.structured(kind)),
            )


def _writable(node: Any) -> Any:
    """Let Hydra write options into what OmegaConf made of a frozen dataclass."""
    OmegaConf.set_readonly(node, None)
    for inner in map(node._get_node, node):
        if isinstance(inner, DictConfig):
            _writable(inner)
    return node
