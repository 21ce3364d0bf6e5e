"""A wheel without the extras loads a policy: the packages of `train` are not needed.

It is built from the source distribution, which is therefore whole.
"""

import os
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

import sfkd_jax

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
VERSION = PROJECT["version"]
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
policy = sfkd_jax.load("kinematic")
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
try:
    sfkd_jax.load("hf://owner/name")
except sfkd_jax.ArtefactError as refused:
    print(refused)
"""
TRAIN = (
    "cvxpy,clarabel,filelock,hydra,omegaconf,jinja2,matplotlib,pandas,pint,pyarrow,"
    "threadpoolctl,brax,gymnasium,huggingface_hub,pytest,yapf"
)
"""What flax itself imports or requires (optax, orbax, rich) is there."""


def built(kind, source, folder):
    """The file that a build of a source tree makes: "sdist" or "wheel"."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", folder]
    done = subprocess.run(command, cwd=source, capture_output=True, text=True)
    if "No module named hatchling" in done.stderr:
        pytest.skip("hatchling is not installed, and nothing is downloaded here")
    assert done.returncode == 0, done.stderr
    (file,) = folder.iterdir()
    return file


def contents(wheel):
    """Its files by name, but for the list of their hashes."""
    with zipfile.ZipFile(wheel) as archive:
        names = [name for name in archive.namelist() if not name.endswith("/RECORD")]
        return {name: archive.read(name) for name in names}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A wheel of the source distribution."""
    folder = tmp_path_factory.mktemp("built")
    with tarfile.open(built("sdist", ROOT, folder / "sdist")) as archive:
        archive.extractall(folder, filter="data")
    return built("wheel", folder / f"sfkd_jax-{VERSION}", folder / "wheel")


@pytest.fixture(scope="module")
def unpacked(wheel):
    site = wheel.parent / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


def test_the_source_distribution_makes_the_same_wheel(wheel, tmp_path):
    assert contents(wheel) == contents(built("wheel", ROOT, tmp_path / "wheel"))


def test_a_command_finds_its_options_in_the_wheel(unpacked, tmp_path):
    done = subprocess.run(
        [sys.executable, "-P", "-m", "sfkd_jax.train", "--help"],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(unpacked)},
    )
    assert done.returncode == 0, done.stderr
    for group in (ROOT / "conf" / "experiment").glob("*.yaml"):
        assert group.stem in done.stdout
    assert [*tmp_path.iterdir()] == []


def test_every_file_states_the_same_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    released = re.findall(
        r"^## \[(\d\S*)\] - \d{4}-\d{2}-\d{2}$", changes, re.MULTILINE
    )
    assert {VERSION, sfkd_jax.__version__, str(cited["version"])} == {released[0]}


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
    train = 'sfkd_jax: this needs hydra: pip install "sfkd-jax[train]"'
    hub = 'hf://owner/name: this needs huggingface_hub: pip install "sfkd-jax[hub]"'
    assert done.stdout.splitlines() == [*3 * [train], hub], done


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
    extras = PROJECT["optional-dependencies"]
    needed = PROJECT["dependencies"] + extras["train"] + extras["hub"]
    lock = (ROOT / "requirements.lock").read_text("utf-8")
    pinned = dict(re.findall(r"^([\w.-]+)==([\w.]+)", lock, re.MULTILINE))
    for requirement in map(Requirement, needed):
        assert pinned[requirement.name] in requirement.specifier
