"""The settings of a run as Hydra's schemas, against which it checks options."""

from __future__ import annotations

import os
from dataclasses import is_dataclass
from typing import Any, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf

from sfkd_jax import assembly
from sfkd_jax.experiment.options import (
    AlongPathSettings,
    LogSettings,
    Settings,
    SimulatedSettings,
)


def _schemas() -> dict[tuple[str, str], Any]:
    """Return the dataclass of every schema, by its group and name."""
    datasets = {"": SimulatedSettings, "path": AlongPathSettings, "files": LogSettings}
    variants: dict[str, Any] = {
        "vehicle": assembly.VEHICLES,
        "model": assembly.MODEL_SETTINGS,
        "controller": assembly.CONTROLLER_SETTINGS,
        "dataset": datasets,
    }
    schemas = {}
    for group, hint in get_type_hints(Settings).items():
        # The primary config states the values of these commands itself.
        if not is_dataclass(hint) or group in ("demo", "collect", "latency"):
            continue
        for variant, dataclass_type in variants.get(group, {"": hint}).items():
            schemas[group, f"{variant}_schema" if variant else "schema"] = (
                dataclass_type
            )
    return schemas


SCHEMAS = _schemas()
"""The dataclass of every schema, by its group and name."""


def register() -> None:
    """Put the dataclasses of all groups into Hydra's store, as schemas."""
    OmegaConf.register_new_resolver("home", os.path.expanduser, replace=True)
    for (group, name), dataclass_type in SCHEMAS.items():
        ConfigStore.instance().store(
            group=group,
            name=name,
            node=_writable(OmegaConf.structured(dataclass_type)),
        )


def _writable(node: Any) -> Any:
    """Let Hydra write options into what OmegaConf made of a frozen dataclass."""
    OmegaConf.set_readonly(node, None)
    for inner in map(node._get_node, node):
        if isinstance(inner, DictConfig):
            _writable(inner)
    return node
