"""Runs from settings to pages; every command starts here, with the extra `train`."""

import sys
from importlib.util import find_spec

TRAIN = (
    *("hydra", "filelock", "optax", "orbax", "cvxpy", "clarabel", "pyarrow", "pint"),
    *("threadpoolctl", "jinja2", "matplotlib", "pandas", "PIL"),
)
"""Modules of the extra `train`."""

# A package that only loads policies is installed without these, and whoever calls a
# command then reads one line instead of a traceback.
for _name in TRAIN:
    try:
        _found = find_spec(_name) is not None
    except ModuleNotFoundError:
        _found = False
    if not _found:
        sys.exit(f'sfkd_jax: this needs {_name}: pip install "sfkd-jax[train]"')
