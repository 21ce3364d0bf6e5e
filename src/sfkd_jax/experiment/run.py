"""A run of the settings of a command: made once, and passed down to all functions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from sfkd_jax import store
from sfkd_jax.certification import boxes_of, check_count
from sfkd_jax.data import Dataset
from sfkd_jax.driving.path_following import PathLaw
from sfkd_jax.driving.plants import Vehicle
from sfkd_jax.experiment import run_directory
from sfkd_jax.experiment.fitting import train_policy
from sfkd_jax.experiment.options import Settings
from sfkd_jax.experiment.source import DataSource
from sfkd_jax.latency import Latency
from sfkd_jax.policy import CERTIFICATE, TrainedModel, restore
from sfkd_jax.ranges import imported
from sfkd_jax.settings import arguments, replace


@dataclass(frozen=True, eq=False)
class Run:
    """The settings of a command, and what follows from them.

    Every property is computed, loaded or made when it is first asked for, and kept.

    Attributes:
        settings: of the command.
        source: of its data, which other runs may share.
    """

    settings: Settings
    source: DataSource

    @classmethod
    def of(cls, settings: Settings) -> Run:
        """Return the run of settings, with a source of data of its own."""
        source = DataSource(
            root=Path(settings.root),
            vehicle=settings.vehicle,
            environment=settings.environment,
            settings=settings.dataset,
        )
        return cls(settings, source)

    def named(self, name: str) -> Run:
        """Return the same run in the directories of another name."""
        return Run(replace(self.settings, name=name), self.source)

    @property
    def directory(self) -> Path:
        """The directory of the run, root/name/system/seed=N; of `system` root/name."""
        settings = self.settings
        if settings.system is not None:
            return Path(settings.root) / settings.name
        folder = Path(settings.root) / settings.name / settings.model.system
        return folder / f"seed={settings.seed}"

    @property
    def policy_path(self) -> Path:
        """The policy of the run, whether or not it exists."""
        return self.directory / "policy.safetensors"

    @property
    def certificate_path(self) -> Path:
        """The certificate of the run, whether or not it exists."""
        return self.directory / CERTIFICATE

    @property
    def plant(self) -> Vehicle:
        """The vehicle."""
        return self.source.plant

    @property
    def law(self) -> PathLaw | None:
        """The law of the data set; None in the frame of the world."""
        return self.source.law

    @cached_property
    def sensors(self) -> tuple[float, ...]:
        """Standard deviations of the sensors of the vehicle, one a state."""
        return self.settings.evaluation.sensors(self.plant)

    @cached_property
    def latency(self) -> Latency:
        """The latency of the vehicle, for each state and control."""
        latency = Latency(**arguments(self.settings.latency, Latency))
        return latency.sized(len(self.plant.states), len(self.plant.controls))

    @cached_property
    def identity(self) -> dict[str, Any]:
        """The settings that determine the weights of the run, as plain values."""
        return {
            **self.source.config,
            "model": store.plain(self.settings.model),
            "training": store.plain(self.settings.training),
            "seed": self.settings.seed,
        }

    def claim(self) -> None:
        """Record the identity of the run in its directory, or check the recorded one.

        Raises:
            ArtefactError: the directory holds a run with other settings.
            ValueError: checkpoints could not be read back from this path.
        """
        run_directory.claim(self.directory, self.policy_path, self.identity)

    @cached_property
    def policy(self) -> TrainedModel:
        """The policy of the run; it is trained, or trained on, if it is missing."""
        # Before the lock and the data: a missing module ends the command at once.
        if factory := getattr(self.settings.model, "factory", None):
            imported(factory, "model.factory")
        if not self.policy_path.is_file():
            # Whether logs are too few for the level is known before the training.
            if self.source.logs:
                count = len(self.source.dataset.calibration.controls)
                level = self.settings.certification.level
                check_count(count, level, "calibration segments")
            with store.locked(self.directory):
                self.claim()
                # Once more under the lock, where nobody else can be writing.
                if not self.policy_path.is_file():
                    train_policy(
                        self.directory,
                        self._policy_settings(self.source.dataset),
                        self.source,
                        self.settings.training,
                        system=self.settings.model.system,
                        seed=self.settings.seed,
                    )
        # Also of a policy that exists: it must have been made with these settings.
        self.claim()
        return restore(self.directory)

    def _policy_settings(self, dataset: Dataset) -> dict[str, Any]:
        """Return the settings to store with a policy, as plain values.

        Of logged data they include E, and the limits of controls unless the settings of
        the vehicle state them.
        """
        # A copy: entries of the identity are changed below.
        recorded = store.plain(self.identity)
        recorded["controller"] = store.plain(self.settings.controller)
        recorded["experiment"] = self.settings.name
        if names := self.settings.environment.names:
            recorded["environment"]["names"] = list(names)
        if self.source.logs:
            # Of logs E is measured, and whoever loads the policy has no logs.
            box = {"low": dataset.env_low.tolist(), "high": dataset.env_high.tolist()}
            recorded["environment"] = box
            vehicle = recorded["vehicle"]
            if vehicle["name"] == "own" and not vehicle["control_low"]:
                low, high = boxes_of(dataset).control
                vehicle["control_low"] = list(low)
                vehicle["control_high"] = list(high)
        if roles := self.settings.environment.roles:
            recorded["environment"]["roles"] = list(roles)
        return recorded
