"""Settings of the test run: they go through the environment, before jax is imported,
and only where unset.
"""

import gc
import os
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".jax_cache")
)
# Both workers and every command compile hundreds of the same small programs.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
# Threads of BLAS wait for each other over small matrices, minutes in one test.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What is compiled here runs once or twice: optimising it, and fusing it by MLIR, took
# half the time of the tests.
_fast = "--xla_backend_optimization_level=0"
if version("jaxlib").startswith("0.10."):  # XLA aborts at a flag that it does not know
    _fast += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", _fast)

_worker = os.environ.get("PYTEST_XDIST_WORKER", "")
if _worker and hasattr(os, "sched_setaffinity"):
    # One core a worker and its children: XLA would else start as many threads as there
    # are cores in each of them.
    _cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {_cores[int(_worker.removeprefix("gw")) % len(_cores)]})

import jax  # noqa: E402
import pytest  # noqa: E402

MAPPINGS = 15000
"""Of memory, where compiled functions are dropped: each holds some, and Linux ends a
process that has 65530.
"""


@pytest.fixture(autouse=True, scope="module")
def _few_mappings() -> Iterator[None]:
    """Drop what was compiled, after a file of tests, before the process has more
    mappings than it may.
    """
    yield
    listed = Path("/proc/self/maps")
    if listed.exists() and listed.read_bytes().count(b"\n") > MAPPINGS:
        jax.clear_caches()


@pytest.fixture
def key() -> jax.Array:
    """One key a test: `jax.random.split` it, never use it twice."""
    return jax.random.key(0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The commands first: some of their files take minutes, and a file that starts last
    decides when the run ends.
    """
    items.sort(key=lambda item: len(item.path.parts))


def pytest_collection_finish() -> None:
    """The garbage collector passes over what was imported, a million objects, every few
    seconds: it need not look at these, and less often at the rest.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)
