"""A wheel without the extras loads a policy: the packages of `train` are not needed."""

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROGRAM = """
import importlib.abc, runpy, sys

class Blocked(importlib.abc.MetaPathFinder):
    names = set(sys.argv[2].split(","))
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in self.names:
            raise ModuleNotFoundError(name, name=name)

sys.meta_path.insert(0, Blocked())
sys.path.insert(0, sys.argv[1])
import sfkd_jax.control
import jax, jax.numpy as jnp
assert sfkd_jax.__file__.startswith(sys.argv[1]), sfkd_jax.__file__
policy = sfkd_jax.load(sys.argv[1] + "/sfkd_jax/pretrained/kinematic")
assert policy.certificate
steps = jnp.arange(1.0, 21.0)
reference = jnp.stack([steps, 0 * steps, 0 * steps, 0 * steps + 10.0], axis=1)
memory = policy.controller.init(jax.random.key(0))
state, env = jnp.array([0.0, 0.3, 0.0, 10.0]), jnp.array([0.6, 0.0])
control, _, info = jax.jit(policy.controller.act)(
    policy.params, memory, state, env, reference
)
assert bool(info.healthy), info
def run(name):
    return lambda: runpy.run_module(f"sfkd_jax.{name}", run_name="__main__")
for start in map(run, ("train", "report", "export")):
    try:
        start()
    except SystemExit as ended:
        print(ended)
"""
TRAIN = (
    "cvxpy,clarabel,filelock,hydra,omegaconf,jinja2,matplotlib,pandas,pint,pyarrow,"
    "threadpoolctl,brax,gymnasium,pytest,yapf"
)
"""What flax itself imports or requires (optax, orbax, rich) is there."""


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps"]
    command += ["--no-build-isolation", "-w", str(folder), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True)
    if "hatchling" in built.stderr:
        pytest.skip("hatchling is not installed, and nothing is downloaded here")
    assert built.returncode == 0, built.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_a_policy_acts_and_a_command_says_what_it_lacks(unpacked):
    compiling = {
        name: value for name, value in os.environ.items() if name[:3] in ("JAX", "XLA")
    }
    done = subprocess.run(
        [sys.executable, "-P", "-c", PROGRAM, str(unpacked), TRAIN],
        capture_output=True,
        text=True,
        cwd=unpacked,
        env={"PATH": "", "PYTHONPATH": ""} | compiling,
    )
    line = 'sfkd_jax: this needs hydra: pip install "sfkd-jax[train]"'
    assert done.stdout.splitlines() == 3 * [line], done


def test_the_lock_pins_the_tested_versions_by_hashes_and_names_no_host():
    lock = (ROOT / "requirements.lock").read_text("utf-8")
    tested = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    assert "://" not in lock
    # A requirement and its hashes, over several lines.
    locked = re.split(r"\n(?=\S)", lock.strip())
    assert [entry.split(" \\\n")[0] for entry in locked] == tested
    for entry in locked:
        digests = re.findall(r"--hash=sha256:([0-9a-f]+)", entry)
        assert digests
        assert all(len(digest) == 64 for digest in digests)


def test_the_lock_has_what_the_package_needs():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = project["dependencies"] + project["optional-dependencies"]["train"]
    lock = (ROOT / "requirements.lock").read_text("utf-8")
    pinned = dict(re.findall(r"^([\w.-]+)==([\w.]+)", lock, re.MULTILINE))
    for requirement in map(Requirement, needed):
        assert pinned[requirement.name] in requirement.specifier
