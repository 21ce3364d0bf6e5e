"""The settings of a run: one dataclass a group, which Hydra takes as its schemas."""

from __future__ import annotations

from dataclasses import field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from sfkd_jax import assembly, export, training
from sfkd_jax.assembly import (
    ControllerSettings,
    Directory,
    LawSettings,
    ModelSettings,
    ScenarioSettings,
    VehicleSettings,
)
from sfkd_jax.certification import measure, prove
from sfkd_jax.driving import drives, simulation
from sfkd_jax.driving.corridor import measure_corridor
from sfkd_jax.driving.plants import KNOWN_STATES, Vehicle, described, roles_of
from sfkd_jax.driving.scenarios import DriveClass
from sfkd_jax.experiment.tube_settings import TubeSettings
from sfkd_jax.latency import Latency
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
from sfkd_jax.settings import OneOf, Values, arguments, parse, replace, schema, takes

Overrides = dict[str, str | None]
Seconds = Annotated[float, Interval("(2, inf)")]
"""The length of an episode, whose first two seconds are not scored."""
empty: Any = partial(field, default_factory=dict)
"""Declares a field that is an empty dictionary by default."""
_BOX = ("env_low", "env_high")
"""Arguments of factories that the settings of the environment decide."""


@takes(sensor=schema("Sensor", object, simulation.observed_environment, skip=("dt",)))
class EnvironmentSettings:
    """What surrounds the vehicle: e in its box, and how a controller learns of it.

    Attributes:
        sensor: delay, noise and bias of a measured e.
        low: lower corner of the box E; None for that of recorded logs.
        high: upper corner of E.
        names: names of the entries of e, with units; () for friction and lateral wind.
        roles: what each entry is, one of friction, mass, side_force, other; () for what
            its name says.
        source: "measured", "estimated" while driving, or "none": e is not observed.
    """

    sensor: Any
    low: Bounds | None = None
    high: Bounds | None = None
    names: Names = ()
    roles: Names = ()
    source: Annotated[str, OneOf(assembly.ENV_SOURCES)] = "measured"

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
        shares: of the training, validation, calibration and test parts.
        seed: of the simulation and of the split.
        steps: number of steps of a segment.
    """

    shares: tuple[Fraction, Fraction, Fraction, Fraction]
    seed: NonNegativeInt = 0
    steps: int = 50

    @property
    def logs(self) -> LogSettings | None:
        """These settings if they are of logs; None if the data are simulated."""
        return self if isinstance(self, LogSettings) else None

    @property
    def along_path(self) -> AlongPathSettings | None:
        """These settings if they are of path coordinates; None in the world."""
        return self if isinstance(self, AlongPathSettings) else None

    @classmethod
    def subclass_for(cls, values: Values) -> type[DatasetSettings]:
        """Return the dataclass of logs, of path coordinates or of the world."""
        if "path" in values:
            return LogSettings
        if "law" in values:
            return AlongPathSettings
        return SimulatedSettings


@takes(drives.generate, skip=("held_out", *_BOX))
class SimulatedSettings(DatasetSettings):
    """Simulated data; the other fields are arguments of the generator."""


@takes(
    drives.generate_along_path,
    DriveClass,
    skip=("limits", "held_out", *_BOX),
    law=LawSettings,
)
class AlongPathSettings(DatasetSettings):
    """Simulated data in path coordinates, around a law.

    Its drives are of a `DriveClass`, whose fields are settings too. `law` holds
    `LawSettings`.
    """

    law: Any

    @property
    def options(self) -> dict[str, Any]:
        """The arguments of `drives.generate_along_path`."""
        options = arguments(self, drives.generate_along_path)
        options["limits"] = DriveClass(**arguments(self, DriveClass))
        return options


@assembly.takes_logs
class LogSettings(DatasetSettings):
    """Recorded logs; the other fields are arguments of `from_logs`."""

    path: str
    columns: Any


@takes(
    training.fit,
    skip=("callback",),
    loss=schema("Loss", object, training.multi_step_loss),
)
class TrainingSettings:
    """How a model is trained; the other fields are arguments of `training.fit`.

    Attributes:
        loss: of `training.multi_step_loss`.
        batch: number of windows in an optimisation step.
        window: number of time steps of a window.
        steps: number of optimisation steps.
        logger: library that the metrics go to, see `experiment.loggers`; None for none.
    """

    loss: Any
    batch: int = 128
    window: int = 20
    steps: int = 4000
    logger: str | None = None


@takes(
    prove,
    measure,
    skip=("validation", "calibration", "held_out", "boxes", "runs"),
    corridor=schema("Corridor", object, measure_corridor, skip=("identified_from",)),
)
class CertificationSettings:
    """What is proved and measured, and who signs it.

    The other fields are arguments of `certification.prove` and `measure`.

    Attributes:
        corridor: of `driving.corridor.measure_corridor`.
        renew: whether `certify` replaces a certificate of other weights.
        signing_key: path of a private ed25519 key in PEM that signs the certificate.
        horizon: number of steps of the tubes.
        level: share of runs that the tubes shall contain.
    """

    corridor: Any
    renew: bool = False
    signing_key: str | None = None
    horizon: int = 20
    level: Fraction = 0.95


@takes()
class EvaluationSettings:
    """Episodes, systems and sensors of the closed loop.

    Attributes:
        episodes: number of episodes for each system.
        episode_s: length of an episode [s].
        seed: of roads, sensors and samplers.
        systems: "self", which is the policy of the run, and reference systems by name.
            With an empty list `train` trains the model and does nothing else.
        observation_noise: standard deviations by name of the state. With None, and
            for a state that is not named, it is that of the vehicle, see
            `plants.KNOWN_STATES`.
        side_forces: largest side forces that no model knows [N]; the episodes are
            simulated once more under each.
    """

    episodes: int = 8
    episode_s: Seconds = 60.0
    seed: NonNegativeInt = 2026
    systems: Names = ("self", "nominal", "oracle")
    observation_noise: dict[str, NonNegative | None] = field(
        default_factory=partial(dict.fromkeys, KNOWN_STATES)
    )
    side_forces: Numbers = ()

    def sensors(self, plant: Vehicle) -> tuple[float, ...]:
        """Return the standard deviations of the sensors of a vehicle, one a state."""
        noise = self.observation_noise
        names = plant.state_names
        # Cars of one comparison may have different ones of the known states.
        if unknown := set(noise) - {*names, *KNOWN_STATES}:
            raise ValueError(
                f"evaluation.observation_noise names {', '.join(sorted(unknown))}, "
                f"the states of the vehicle are {', '.join(names)}"
            )
        stated = {name: value for name, value in noise.items() if value is not None}
        return tuple(stated.get(state.name, state.deviation) for state in plant.states)


@takes()
class ComparisonSettings:
    """The rows and columns of `compare`.

    Attributes:
        policies: the name under which the policies of the rows are trained.
        vehicles: options of the group `vehicle`.
        seeds: seeds of the trainings.
        controllers: option of the group `controller` -> the scenarios that it drives.
        own_controllers: label of a row -> controller -> the controller that this row
            has instead; None if it has none.
        rows: label of a row -> its overrides.
        one_seed: labels of the rows that are evaluated with the first seed only, such
            as those that are not trained.
        tuned: vehicle -> label of a row -> further overrides.
        only: labels of the rows to evaluate; with an empty list all of them.
        share: [k, n]: evaluate every n-th row from the k-th on, and collect nothing.
        paper: the numbers that the paper prints, for the page of the comparison.
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


@takes(Latency)
class LatencySettings:
    """The arguments of `Latency`: what is late when a policy is certified and driven.

    Data and training do not depend on it.
    """


@takes()
class DemoSettings:
    """Episodes of `demo`, and its page.

    Attributes:
        episodes: number of episodes for each system.
        episode_s: length of an episode [s].
        port: of the page that `viewer` opens; 0 for any that is free.
    """

    episodes: int
    episode_s: Seconds
    port: Annotated[int, Interval("[0, 65535]")]


@takes()
class CollectSettings:
    """The runs that `collect` reads.

    Attributes:
        path: a file, a folder or a glob.
    """

    path: str


@takes()
class Settings:
    """All settings of a command; conf/config.yaml chooses their options."""

    seed: NonNegativeInt
    name: Directory
    root: str
    optimized: bool
    scaled: bool
    system: str | None
    viewer: bool
    vehicle: VehicleSettings
    environment: EnvironmentSettings
    scenario: ScenarioSettings
    dataset: DatasetSettings
    model: ModelSettings
    controller: ControllerSettings
    training: TrainingSettings
    latency: LatencySettings
    certification: CertificationSettings
    evaluation: EvaluationSettings
    tubes: TubeSettings
    comparison: ComparisonSettings
    export: ExportSettings
    demo: DemoSettings
    collect: CollectSettings


def parse_settings(values: Values) -> Settings:
    """Return checked settings; with `environment.source=none` the model reads no e."""
    settings = parse(Settings, values)
    _check_estimated(settings)
    environment = settings.environment
    reads_env = settings.model.environment and environment.is_known
    vehicle = settings.vehicle
    # Recorded with the run: whoever loads its policy need not have the simulator.
    if simulator := getattr(vehicle, "env", None):
        stated = described(simulator)
        vehicle = replace(vehicle, **stated.arguments)
        environment = replace(
            environment,
            names=environment.names or stated.environment_names,
            roles=environment.roles or stated.environment_roles,
        )
    _check_env_names(environment)
    return replace(
        settings,
        model=replace(settings.model, environment=reads_env),
        root=str(Path(settings.root).expanduser()),
        vehicle=vehicle,
        environment=environment,
    )


def _check_estimated(settings: Settings) -> None:
    """Raise a ValueError if e shall be estimated where nothing can estimate it."""
    environment = settings.environment
    if environment.source != "estimated":
        return
    if not settings.model.environment:
        raise ValueError(
            "environment.source=estimated needs a model that reads the environment; "
            "drop model.environment=false"
        )
    # Whoever estimates e follows a path, and tells apart what differs.
    why = None
    if settings.dataset.logs:
        why = "logs train none"
    elif environment.low and environment.low == environment.high:
        why = f"e is always {environment.low}"
    if why:
        raise ValueError(
            "environment.source=estimated needs a model in path coordinates and an "
            f"environment that varies: {why}; pass environment.source=measured or none"
        )


def _check_env_names(environment: EnvironmentSettings) -> None:
    """Raise a ValueError unless every entry of the box of e has a name, or none has."""
    names = environment.names
    if names and environment.low and len(names) != len(environment.low):
        raise ValueError(
            f"environment.low and environment.high need {len(names)} entries, "
            f"for {', '.join(names)}"
        )
    if environment.roles and (names or environment.low):
        # Entries without names are only counted.
        roles_of(names or tuple(map(str, environment.low or ())), environment.roles)
