"""What the data of a run are made from: a vehicle in its environment."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax

from sfkd_jax import assembly, store
from sfkd_jax.assembly import VehicleSettings
from sfkd_jax.data import Dataset
from sfkd_jax.driving.path_following import PathLaw
from sfkd_jax.driving.plants import Vehicle, check_step, hidden_change
from sfkd_jax.experiment import data, dataset_files, identified, laws
from sfkd_jax.experiment.options import (
    AlongPathSettings,
    DatasetSettings,
    EnvironmentSettings,
    LogSettings,
)
from sfkd_jax.settings import replace
from sfkd_jax.types import Trajectory

COMMAND_LAGS = "command_lags.json"
"""File beside the data set of logs that says how late each command acts."""


@dataclass(frozen=True, eq=False)
class DataSource:
    """A vehicle in its environment, and the data that are made from it.

    Every property is computed, loaded or made when it is first asked for, and kept.
    Runs with equal `config` share one source in a process, and its files in `root`.

    Attributes:
        root: the directory of all artefacts.
        vehicle: settings of the vehicle.
        environment: settings of E.
        settings: of the data set.
    """

    root: Path
    vehicle: VehicleSettings
    environment: EnvironmentSettings
    settings: DatasetSettings

    @property
    def logs(self) -> LogSettings | None:
        """The settings of logs; None if the data are simulated."""
        return self.settings.logs

    @property
    def along_path(self) -> AlongPathSettings | None:
        """The settings of path coordinates; None for those of the world."""
        return self.settings.along_path

    @property
    def box(self) -> dict[str, Any]:
        """The corners of E, as arguments of factories."""
        return self.environment.box

    @property
    def has_simulator(self) -> bool:
        """Whether the vehicle is a simulator on the host, which may fail."""
        return bool(getattr(self.vehicle, "env", None))

    @cached_property
    def config(self) -> dict[str, Any]:
        """The settings that the data depend on, as plain values."""
        return dataset_files.config(self.vehicle, self.environment, self.settings)

    @cached_property
    def path(self) -> Path:
        """The path of the data set, whether or not it exists."""
        digest = store.sha256(self.config)[:8]
        folder = f"{self.vehicle.name}-{digest}"
        return self.root / "datasets" / folder / "dataset.safetensors"

    @cached_property
    def plant(self) -> Vehicle:
        """The vehicle."""
        return assembly.build_vehicle(self.vehicle)

    def check_plant(self) -> None:
        """Raise a ValueError if the vehicle cannot be simulated in its environment."""
        check_step(self.plant, len(self.environment.low or (0, 0)))

    @cached_property
    def law(self) -> PathLaw | None:
        """The law of the data set, derived if it is missing; None in the world."""
        if self.along_path is None:
            return None
        path = self.path.with_name("law.safetensors")
        if not path.is_file():
            law = laws.derive_law(
                self.plant,
                self.along_path,
                self.box,
                simulator=self.has_simulator,
            )
            laws.write(path, law, self.config)
        return laws.read(path, self.config)

    def with_law_of(self, model: str) -> DataSource:
        """Return a source along a path whose law is derived from another model."""
        drives: Any = self.along_path
        law = replace(drives.law, model=model)
        return dataclasses.replace(self, settings=replace(drives, law=law))

    @cached_property
    def loop(self) -> Vehicle:
        """The closed loop of vehicle and law, in path coordinates."""
        law: Any = self.law
        return assembly.build_loop(self.plant, law)

    @property
    def dataset(self) -> Dataset:
        """The data set, simulated or read from logs if it is missing."""
        dataset, _ = self._stored
        return dataset

    @property
    def dataset_sha256(self) -> str:
        """The hash of the data set."""
        _, digest = self._stored
        return digest

    @cached_property
    def _stored(self) -> tuple[Dataset, str]:
        """The data set and its hash."""
        path = self.path
        if not path.is_file():
            with store.locked(path.parent, wait=True):  # other runs share the data set
                # Another run may have made it while this one waited for the lock.
                if not path.is_file():
                    dataset_files.write(path, self._make(), self.config)
        # Read back even if it is new: every run trains on what is stored.
        return dataset_files.read(
            path,
            self.config,
            self.environment,
            logged=self.logs is not None,
        )

    @property
    def command_lags(self) -> dict[str, Any]:
        """How late each command acts in the logs of the data set; {} without logs."""
        path = self.path.with_name(COMMAND_LAGS)
        return store.read_json(path) if path.is_file() else {}

    def _make(self) -> Dataset:
        """Return a new data set; what was found of logs is written beside it."""
        if self.logs is None:
            self.check_plant()
            self._report_hidden_states()
            return data.simulate(
                self._drive(),
                self.settings,
                self.box,
                simulator=self.has_simulator,
            )
        logged = identified.read(self.plant, self.environment, self.logs)
        store.write_json(self.path.with_name("coverage.json"), logged.coverage)
        lags = {name: lag._asdict() for name, lag in logged.command_lags.items()}
        store.write_json(self.path.with_name(COMMAND_LAGS), lags)
        return logged.dataset

    def _report_hidden_states(self) -> None:
        """Print which states of a simulator go wrong because it has others."""
        settings: Any = self.settings
        if not self.has_simulator or self.environment.low is None:
            return
        vehicle: Any = self.vehicle
        found = hidden_change(vehicle.env, self.plant, speed=settings.speed, **self.box)
        if not found:
            return
        listed = ", ".join(f"{name} by {value:.3g}" for name, value in found.items())
        store.print_message(
            f"simulator {vehicle.env}: two steps from one reset differ from two resets "
            f"in {listed} (RMS): it has states that neither state_names nor "
            "hidden_names name. They start anew at every step, so another vehicle is "
            "learned and certified"
        )

    def _drive(self, *, switching: bool = False, **changes: int) -> data.Drive:
        """Return key -> runs of the vehicle or of its closed loop, see `data.drive`."""
        plant = self.plant if self.along_path is None else self.loop
        return data.drive(
            plant,
            self.settings,
            self.box,
            switching=switching,
            **changes,
        )

    @cached_property
    def held_out(self) -> dict[str, Trajectory]:
        """The trajectories on which coverage is measured, by name.

        These are the test part, its segments of each scenario, and as many runs of S3,
        which training never uses. Of logged runs, without scenarios, it is the test
        part.
        """
        dataset = self.dataset
        parts = {"test": dataset.test}
        if dataset.scenarios is None:
            return parts
        parts["s3"] = self._switching_runs(dataset.test.controls.shape[0])
        return {**parts, **data.by_scenario(dataset)}

    def _switching_runs(self, count: int) -> Trajectory:
        """Return so many runs under the switching of S3."""
        simulate = jax.jit(self._drive(switching=True, segments=count))
        seed = jax.random.key(self.settings.seed)
        # A stream of its own: S3 must not repeat what the training data drew.
        runs = simulate(jax.random.fold_in(seed, data.SWITCHING_STREAM))
        (kept,) = laws.without_faults(runs, simulator=self.has_simulator)
        return kept
