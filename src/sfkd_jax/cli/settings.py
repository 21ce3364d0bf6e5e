"""Settings that are arguments of no factory."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

from sfkd_jax.cli.schemas import BelowRoot, FileNames
from sfkd_jax.ranges import (
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

_Directory = Annotated[str, BelowRoot()]
_Overrides = Annotated[dict[str, str | None], FileNames()]
_Seconds = Annotated[float, Interval("(2, inf)")]
"""Of an episode; the first two seconds are not scored."""


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
        systems: "self" and reference systems; none: `train` trains alone.
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


class Renewal(NamedTuple):
    """Whether `certify` replaces a certificate of other weights."""

    renew: bool = False


class Comparison(NamedTuple):
    """The rows and columns of `compare`; conf/comparison/none.yaml explains each."""

    policies: _Directory
    vehicles: Names
    seeds: Annotated[tuple[NonNegativeInt, ...], Entries(least=0)]
    only: Names
    untrained: Names
    trained_once: Names
    rows: _Overrides
    tuned: dict[str, dict[str, str]]
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
    adaptive: bool = False
