"""Runs from settings to pages; every command starts here, with the extra `train`."""

import sys
from importlib.util import find_spec

TRAIN = (
    "hydra",
    "filelock",
    "optax",
    "orbax",
    "cvxpy",
    "clarabel",
    "pyarrow",
    "pint",
    "threadpoolctl",
    "jinja2",
    "matplotlib",
    "pandas",
    "PIL",
)
"""Modules that the extra `train` installs."""


def _is_installed(name: str) -> bool:
    """Return whether a module can be imported."""
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


# A package that only loads policies is installed without these, and whoever calls a
# command then reads one line instead of a traceback.
for _name in TRAIN:
    if not _is_installed(_name):
        sys.exit(f'sfkd_jax: this needs {_name}: pip install "sfkd-jax[train]"')
