"""The option files below conf/: their groups, names and defaults."""

from __future__ import annotations

from pathlib import Path

from omegaconf import OmegaConf

GROUPS = {
    "vehicle": "the simulated vehicle; own is your own, with a step or with logs",
    "scenario": "friction and wind along the road",
    "dataset": "simulated training data, or log files",
    "model": "the learned dynamics",
    "controller": "the planner and its cost",
    "training": "loss, batches and optimiser",
    "certification": "what is proved, and at which level",
    "evaluation": "episodes, systems and sensors of the closed loop",
    "comparison": "rows and columns of a table, for compare",
    "export": "platforms of an exported controller",
}
"""Group of options -> what its options choose."""
EXPERIMENT = "experiment"
"""The group whose options choose options of the others; none by default."""
SCHEMA = "schema"
"""Ending of the names in Hydra's store that are no options."""


def conf_path() -> str:
    """Return the folder of options: of the checkout, or of the installed package."""
    package = Path(__file__).resolve().parents[1]
    checkout = package.parents[1]
    inside = (checkout / "conf" / "config.yaml").exists() and (
        checkout / "pyproject.toml"
    ).exists()
    return str(checkout / "conf" if inside else package / "conf")


def options(group: str) -> list[str]:
    """Return the names of the options of a group."""
    return sorted(file.stem for file in Path(conf_path(), group).glob("*.yaml"))


def defaults() -> dict[str, str]:
    """Return the option of each group that is chosen if nothing else is."""
    listed = OmegaConf.load(Path(conf_path(), "config.yaml")).defaults
    return {
        str(group): option
        for entry in listed
        if OmegaConf.is_dict(entry)
        for group, option in entry.items()
        if group in GROUPS
    }
