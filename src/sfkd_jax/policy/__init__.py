"""Load trained controllers, without Hydra, orbax, convex solvers or matplotlib."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import jax

from sfkd_jax import assembly, store
from sfkd_jax.certificate import describe_signature
from sfkd_jax.driving.certificate import DrivingCertificate
from sfkd_jax.driving.path_following import in_the_world
from sfkd_jax.driving.plants import FRICTION, roles_of
from sfkd_jax.latency import NO_LATENCY, Latency
from sfkd_jax.policy._calling import entrance, with_capacity
from sfkd_jax.policy._certificate import SavedHashes, save_certificate
from sfkd_jax.policy._certificate import read_certificate as read_certificate
from sfkd_jax.policy._description import describe, interface_of
from sfkd_jax.policy._files import CERTIFICATE as CERTIFICATE
from sfkd_jax.policy._files import POLICY_FILE
from sfkd_jax.policy._files import RECORDED as RECORDED
from sfkd_jax.policy._hub import Shareable as Shareable
from sfkd_jax.policy._hub import located
from sfkd_jax.policy._shipped import SHIPPED as SHIPPED
from sfkd_jax.policy._shipped import ShippedPolicy as ShippedPolicy
from sfkd_jax.policy._shipped import policies as policies
from sfkd_jax.policy._system_policy import SYSTEM_KIND as SYSTEM_KIND
from sfkd_jax.policy._system_policy import SystemPolicy as SystemPolicy
from sfkd_jax.policy._system_policy import TrainedSystem as TrainedSystem
from sfkd_jax.policy._system_policy import describe_system as describe_system
from sfkd_jax.policy._system_policy import is_system as is_system
from sfkd_jax.policy._system_policy import load_system as load_system
from sfkd_jax.policy._system_policy import planner_of as planner_of
from sfkd_jax.policy._system_policy import restore_system as restore_system
from sfkd_jax.policy._system_policy import save_system as save_system
from sfkd_jax.policy._system_policy import shielded as shielded
from sfkd_jax.policy._system_policy import system_file as system_file
from sfkd_jax.policy._system_policy import system_model as system_model
from sfkd_jax.policy._trained import KIND as KIND
from sfkd_jax.policy._trained import LAW as LAW
from sfkd_jax.policy._trained import TrainedModel as TrainedModel
from sfkd_jax.policy._trained import built as built
from sfkd_jax.policy._trained import in_policy_numerics, policy_numerics
from sfkd_jax.policy._trained import policy_file as policy_file
from sfkd_jax.policy._trained import restore as restore
from sfkd_jax.policy._trained import save as save
from sfkd_jax.rollout import fold, on_host, unfold
from sfkd_jax.settings import Values
from sfkd_jax.types import Controller, Params


@dataclass(frozen=True, eq=False)
class Policy(TrainedModel, Shareable):
    """A trained controller, as `load` returns it; `params` are folded for it.

    Attributes:
        controller: `Controller(init, act)`, pure; jit, vmap or scan it.
        certificate: the verified certificate, or None if it is missing, refused or
            stale.
        signature: who signed the certificate, its measured numbers included: "unsigned"
            or "signed by …".
        around: (planner=another along a path) -> controller, see
            `assembly.build_controller`.
        latency: of the vehicle, which the controller compensates.
    """

    controller: Controller
    certificate: DrivingCertificate | None
    signature: str
    around: Callable[..., Controller]
    latency: Latency

    @property
    def interface(self) -> dict[str, Any]:
        """Names, units and limits of controls, observation, e and reference."""
        return interface_of(self, self.certificate, self.latency)

    def __repr__(self) -> str:
        """Say what it drives, where its certificate applies, and what is proved."""
        return describe(self, self.certificate, self.signature, self.latency)

    def _with_corridor(self) -> DrivingCertificate:
        """Return the certificate, or raise a ValueError if it has no corridor."""
        if self.certificate is None or self.certificate.corridor is None:
            raise ValueError(
                "this policy has no certified corridor to keep a planner in: load one "
                "in path coordinates with its certificate, as by "
                'sfkd_jax.load("dynamic_path")'
            )
        return self.certificate

    def shield(self, planner: Controller, *, along_path: bool = False) -> Controller:
        """Return any planner behind the shield of this policy, to be called like it.

        Args:
            planner: its `act` receives the params of the policy (bind others with
                `partial`), the observation, e and the reference, and returns a control
                of the vehicle. Its `info` is the part `planner` of the result.
            along_path: whether it takes ξ and a preview instead of observation and
                reference, see `path_following.along_reference`.

        Raises:
            ValueError: the policy has no certified corridor.
        """
        self._with_corridor()
        # Its settings are numbers, also where a program is traced when it is built.
        with jax.ensure_compile_time_eval():
            if not along_path:
                planner = in_the_world(planner)
            return entrance(self.around(planner=planner), self)

    def in_lane(
        self,
        *,
        car: tuple[float, float] | None = None,
        planner: str = "mppi",
        capacity: tuple[int, int] | None = None,
        reverse: bool = False,
        candidates: int = 0,
    ) -> Controller:
        """Return a controller that drives in a lane, round obstacles, see `InLane`.

        Its `act` takes (`Lane`, `Obstacles`) in place of the reference.

        Args:
            car: length and width [m], by default those of the vehicle; its middle is
                the observed position.
            planner: name of the planner that searches for a reference, "mppi" or "cem".
            capacity: largest number of obstacles, and of predicted positions of each.
                `act` is then to be called as it is, from the host: it takes any number
                of obstacles up to these, and is compiled once. With None it is a pure
                function, for `jax.jit` and scans, of one number of obstacles each.
            reverse: whether the vehicle reverses where u_2 is below 0 at rest. It then
                backs up where it stands too near to something to turn away, without a
                claim, see `path_following.Reversing`.
            candidates: number of references that are drawn as the search draws them, to
                be shown in `info.lane.candidates`.

        Raises:
            ValueError: the policy has no certified corridor.
        """
        certificate = self._with_corridor()
        law = self.law
        # A corridor is about path coordinates, and these about a law.
        assert law is not None
        roles = roles_of(
            self.interface["environment"]["names"],
            self.settings["environment"].get("roles", ()),
        )
        with jax.ensure_compile_time_eval():
            controller = assembly.build_in_lane(
                self.controller,
                self.vehicle,
                law,
                certificate,
                horizon=self.interface["horizon"],
                car=car or self.vehicle.size,
                planner=planner,
                friction=roles.index(FRICTION) if FRICTION in roles else None,
                reverse=reverse,
                candidates=candidates,
            )
        if capacity is not None:
            controller = with_capacity(controller, capacity)
        return in_policy_numerics(controller)

    def __reduce__(self) -> Any:
        """Refuse to be pickled; functions of a closure say less clearly why."""
        raise TypeError("a Policy cannot be pickled: sfkd_jax.load it in that process")

    @property
    def weights(self) -> Params:
        """The learned parameters as they were saved, to train on or to save again."""
        return unfold(self.params)

    @property
    def reference_shape(self) -> tuple[int, int]:
        """Shape of the reference that `act` takes: a row at each of the next steps."""
        return self.interface["horizon"], len(self.interface["reference"])

    def save(self, folder: Path) -> SavedHashes:
        """Write the policy and its certificate, for `load`."""
        path = folder / POLICY_FILE
        manifest = save(path, self.weights, self.settings, law=self.law)
        return save_certificate(folder, manifest, self.certificate)


if TYPE_CHECKING:
    # Editors complete the policy of a vehicle, which is what most callers load.
    Loaded: TypeAlias = Policy
else:
    Loaded = Policy | SystemPolicy


@policy_numerics()
def load(
    path: str | Path,
    *,
    controller: Mapping[str, Any] | None = None,
    env_source: str = "measured",
    adaptive: bool = False,
    latency: Latency | None = None,
    signed_by: str | Path | None = None,
) -> Loaded:
    """Return the policy in a run directory, with its certificate verified.

    Without a certificate it warns and gives the reason. Of a directory that
    `certify_system` has made it returns a `SystemPolicy`.

    Args:
        path: path of the directory or of a policy.safetensors, the name of a policy
            that ships, see `policies`, or the address of one on the Hugging Face Hub,
            "hf://owner/name" or "hf://owner/name@revision".
        controller: settings of a controller to build instead of the saved one.
        env_source: one of `assembly.ENV_SOURCES`. "estimated" for a policy in path
            coordinates that estimates the environment and ignores the one it is given;
            "none" for a policy that reads none.
        adaptive: whether a policy in path coordinates estimates unmeasured forces and
            errors of its inputs while driving, see `path_following.Adaptation`.
        latency: of the vehicle, which the controller compensates. None for that of an
            export, or else of the certificate. With another one than that of the
            certificate nothing is claimed.
        signed_by: public ed25519 key of who must have signed the certificate, as 64
            hexadecimal digits or the path of a PEM file. Only a signature vouches for
            measured numbers. None to accept an unsigned certificate, too.

    Raises:
        ArtefactError: as `restore`, or a certificate that does not hold, or one that
            `signed_by` has not signed, or there is no policy at an address.
        ValueError: `controller`, `env_source` or `latency` does not fit the policy, or
            an estimate is asked of a policy that is not in path coordinates.
    """
    path = located(path)
    if is_system(path):
        if controller or latency or adaptive or signed_by or env_source != "measured":
            raise ValueError(f"{path} is the policy of a system: load it by path alone")
        of_system: Any = load_system(path)
        return of_system
    return _load_vehicle(path, controller, env_source, adaptive, latency, signed_by)


def _load_vehicle(
    path: str | Path,
    controller: Mapping[str, Any] | None,
    env_source: str,
    adaptive: bool,
    latency: Latency | None,
    signed_by: str | Path | None,
) -> Policy:
    """Return the policy of a vehicle; see `load`."""
    file = policy_file(path)
    trained = restore(path)
    # Here, so that a certificate is checked on the weights that will be multiplied.
    trained = replace(trained, params=fold(trained.model, trained.params, on_host))
    certificate, reason = read_certificate(path, trained, signed_by=signed_by)
    with store.as_artefact_error(file):
        reads_env = trained.settings["model"].get("environment", True)
        settings = _driving_settings(trained.settings, controller, env_source)
    has_corridor = certificate is not None and certificate.corridor is not None
    # Never the same planner without its shield, unless the caller says so.
    if settings["controller"].get("shield") and not has_corridor:
        raise store.ArtefactError(
            f"{file}: controller.shield needs a certified corridor, and "
            f"{reason or 'the certificate has none'}; run certify, or load it with "
            "controller=... and shield=False"
        )
    _check_env_source(env_source, reads_env)
    # Errors are about the file, unless the caller asked for something else.
    unchanged = controller is None and latency is None
    as_saved = unchanged and env_source == "measured" and not adaptive
    with store.as_artefact_error(file, ValueError) if as_saved else nullcontext():
        compensated = _latency_of(trained, certificate, latency)
        around = partial(
            assembly.build_controller,
            settings["controller"],
            trained.model,
            trained.vehicle,
            env_low=settings["environment"]["low"],
            env_high=settings["environment"]["high"],
            env_source=env_source,
            certificate=certificate,
            law=trained.law,
            adaptive=adaptive,
            latency=compensated,
        )
        planner = around()
    # What the certificate states is not added: it is bound to the settings as they are.
    settings = settings if latency is None else _stating(settings, compensated)
    signature = "unsigned"
    if certificate is not None:
        signature = describe_signature(certificate.sha256, certificate.signature)
    else:
        # 4: `load` and `policy_numerics` stand between this function and the caller.
        warnings.warn(f"{file}: nothing is certified; {reason}", stacklevel=4)
    return Policy(
        **vars(replace(trained, settings=settings)),
        controller=entrance(planner, trained),
        certificate=certificate,
        signature=signature,
        around=around,
        latency=compensated,
    )


def _stating(settings: Values, latency: Latency) -> Values:
    """Return settings with a latency, which an export of the policy then has too."""
    return settings if latency.is_none else {**settings, "latency": asdict(latency)}


def _latency_of(
    trained: TrainedModel,
    certificate: DrivingCertificate | None,
    latency: Latency | None,
) -> Latency:
    """Return the latency to drive with, for each state and control.

    Args:
        trained: the policy. What `export` writes states a latency in its settings.
        certificate: whose corridor states the latency that it was measured with.
        latency: that the caller states, or None.
    """
    if latency is None and "latency" in trained.settings:
        saved = trained.settings["latency"]
        latency = Latency(
            **{kind: tuple(map(float, delays)) for kind, delays in saved.items()}
        )
    if latency is None:
        corridor = certificate.corridor if certificate else None
        latency = corridor.conditions.latency if corridor else NO_LATENCY
    vehicle = trained.vehicle
    return latency.sized(len(vehicle.states), len(vehicle.controls))


def _driving_settings(
    saved: Values, controller: Mapping[str, Any] | None, env_source: str
) -> dict[str, Any]:
    """Return the saved settings with the controller and the source of e to drive with.

    As loaded without options they are those of the file, to which a signature refers.

    Args:
        saved: the settings in the file of the policy.
        controller: settings of a controller in place of the saved one, or None.
        env_source: one of `assembly.ENV_SOURCES`.
    """
    environment = saved["environment"]
    if env_source != environment.get("source", "measured"):
        environment = {**environment, "source": env_source}
    return {
        **saved,
        "environment": environment,
        "controller": controller or saved["controller"],
    }


def _check_env_source(env_source: str, reads_env: bool) -> None:
    """Raise a ValueError unless a policy can take its environment from this source.

    What a model reads must come from somewhere; what it does not is not estimated.
    """
    impossible = "none" if reads_env else "estimated"
    sources = [source for source in assembly.ENV_SOURCES if source != impossible]
    if env_source not in sources:
        raise ValueError(
            f"env_source must be {' or '.join(sources)} for a policy that "
            f"{'reads' if reads_env else 'ignores'} the environment, got {env_source!r}"
        )
