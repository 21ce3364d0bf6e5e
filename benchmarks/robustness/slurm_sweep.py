"""Sweeps under a real Slurm: jobs that fail, that are requeued, cancelled, out of time, and too large for the node.

python -m benchmarks.robustness.slurm_sweep [--only failures requeue limit large --out
benchmarks/robustness/slurm_sweep.json] As root on Debian: apt-get install munge slurmctld slurmd
slurm-client. The cluster (slurm_cluster.py) is one node with two CPUs on the loopback
address and goes when the script ends. A job is the small run of drills.py. What the
file says of drills that are not asked for stays.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import harness
from benchmarks.robustness import drills
from benchmarks.robustness.slurm_cluster import Cluster

LAUNCHER = (
    "hydra/launcher=cluster",
    "hydra.launcher.cpus_per_task=1",
    "hydra.launcher.mem_gb=3",
)
SWEPT = "training.learning_rate"
LONG = ("training.steps=2000", "training.log_every=25", "training.save_every=25")
"""Training of some minutes, so that there is time to disturb it."""


class Sweep:
    """`train` swept over learning rates, in a folder of its own."""

    def __init__(self, cluster, directory, rates, *options, minutes=20):
        """Start it."""
        directory.mkdir(exist_ok=True)
        cache = str(cluster.directory.parents[1] / "cache")
        env = {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        } | cluster.env
        env |= {
            "XLA_FLAGS": "--xla_backend_optimization_level=0",
            "TF_CPP_MIN_LOG_LEVEL": "3",
        }
        args = [
            *drills.JOB,
            *LAUNCHER,
            f"hydra.launcher.timeout_min={minutes}",
            f"{SWEPT}={rates}",
            *options,
            "--multirun",
        ]
        self.directory, self.cluster, self.began = directory, cluster, time.monotonic()
        self._said = (directory / f"said{len(list(directory.glob('said*')))}.txt").open(
            "w+"
        )
        command = [sys.executable, "-m", "sfkd_jax.train", *args]
        out = {"stdout": subprocess.DEVNULL, "stderr": self._said}
        self.process = subprocess.Popen(
            command, cwd=directory, env=env, start_new_session=True, **out
        )
        cluster.clients.append(self.process)

    def run(self, rate):
        """The run directory of a job."""
        return self.directory / "runs/smoke" / f"{SWEPT}={rate}" / "sfkd/seed=0"

    def step(self, rate):
        """The newest checkpoint of a job."""
        steps = [
            int(file.name)
            for file in (self.run(rate) / "checkpoints").glob("*")
            if file.name.isdigit()
        ]
        return max(steps, default=0)

    def until(self, reached, seconds=400):
        """Wait for something to happen.

        Raises:
            SystemExit: it does not, or the sweep ended before.
        """
        while not reached():
            if (
                time.monotonic() - self.began > seconds
                or self.process.poll() is not None
            ):
                raise SystemExit(f"it did not happen: {self.lines()[-5:]}")
            time.sleep(0.2)

    def lines(self):
        """What was said of jobs and of the sweep."""
        self._said.flush()
        message = Path(self._said.name).read_text().replace(str(self.directory), "")
        return [
            line
            for line in message.splitlines()
            if line.startswith("sfkd_jax: ") or "Traceback" in line
        ]

    def ended(self, seconds=900):
        """Exit status, how long it took, and what it said."""
        status = self.process.wait(timeout=seconds)
        result = {
            "status": status,
            "seconds": round(time.monotonic() - self.began),
            "said": self.lines(),
        }
        print(json.dumps(result, indent=1), flush=True)
        return result

    def left(self, rate):
        """What a finished job left, less its times."""
        return {name: drills.content(self.run(rate) / name) for name in drills.SAME}


def failures(cluster, directory):
    """Two good jobs and two bad ones: one that is refused, one whose loss is not
    finite; then the same sweep again.
    """
    rates = "0.001,0.003,-1,1e30"
    first = Sweep(cluster, directory, rates)
    result = {"rates": rates, "first": first.ended()}
    before = {
        rate: (first.run(rate) / "policy.npz").stat().st_mtime_ns
        for rate in (0.001, 0.003)
    }
    left = {rate: first.left(rate) for rate in before}
    again = Sweep(cluster, directory, rates)
    result["again"] = again.ended()
    saved = {
        rate: (again.run(rate) / "policy.npz").stat().st_mtime_ns for rate in before
    }
    result["good_trained_again"] = saved != before
    result["good_changed"] = [
        name
        for rate in left
        for name in left[rate]
        if again.left(rate)[name] != left[rate][name]
    ]
    result["directories"] = sorted(
        path.name for path in (directory / "runs/smoke").iterdir()
    )
    return result


def requeue(cluster, directory):
    """Of four jobs on two CPUs one is requeued while it trains, a running and a pending
    one are cancelled.
    """
    measure = _undisturbed(cluster, directory.parent / "undisturbed")
    sweep = Sweep(cluster, directory / "disturbed", "0.001,0.002,0.003,0.004", *LONG)
    sweep.until(lambda: sweep.step(0.001) >= 100 and sweep.step(0.002) >= 100)
    array = next(
        job.split("_")[0] for job, state in cluster.jobs().items() if state == "RUNNING"
    )
    at = sweep.step(0.001)
    cluster.ask("scontrol", "requeue", f"{array}_0")
    cluster.ask("scancel", f"{array}_3")
    sweep.until(lambda: cluster.jobs()[f"{array}_2"] == "RUNNING")
    cluster.ask("scancel", f"{array}_2")
    result = {"requeued_at_step": at, "sweep": sweep.ended()}
    result["different"] = _different(measure, sweep)
    return result | {"resumed_at_steps": _resumed(sweep)}


def limit(cluster, directory):
    """A time limit in mid-training: the job is queued again until it is done, or told
    in a line if it must not be.
    """
    measure = _undisturbed(cluster, directory.parent / "undisturbed")
    short = (*LONG, "hydra.launcher.signal_delay_s=20")
    sweep = Sweep(cluster, directory / "limited", "0.001,0.002", *short, minutes=3)
    result = {"minutes": [3, 1], "queued_again": sweep.ended(seconds=3000)}
    result["different"] = _different(measure, sweep)
    result["resumed_at_steps"] = _resumed(sweep)
    once = Sweep(
        cluster,
        directory / "once",
        "0.001,0.002",
        *short,
        "hydra.launcher.max_num_timeout=0",
        minutes=1,
    )
    return result | {"not_queued_again": once.ended()}


def large(cluster, directory):
    """More than the node has: processors, memory, accelerators, time, nodes."""
    args = (
        "cpus_per_task=64",
        "mem_gb=4096",
        "gpus_per_node=1",
        "timeout_min=10000",
        "nodes=3",
    )
    result = {}
    for number, option in enumerate(args):
        result[option] = Sweep(
            cluster, directory / str(number), "0.001,0.002", f"hydra.launcher.{option}"
        ).ended()
    return result


def _undisturbed(cluster, directory):
    """The measure of two drills: the good jobs, left alone.

    Raises:
        SystemExit: they fail.
    """
    sweep = Sweep(
        cluster, directory, "0.001,0.002", *LONG
    )  # the second time there is nothing to do
    if sweep.ended()["status"]:
        raise SystemExit("undisturbed jobs failed")
    return sweep


def _different(one, other):
    """What two sweeps left that is not the same, bit for bit less times."""
    pairs = [(rate, one.left(rate), other.left(rate)) for rate in (0.001, 0.002)]
    return [
        f"{rate}: {name}" for rate, a, b in pairs for name in a if a[name] != b[name]
    ]


def _resumed(sweep):
    """At which steps the training of each job began or went on, by the names of its
    event files.
    """
    boards = {
        rate: (sweep.run(rate) / "tensorboard").glob("*.*") for rate in (0.001, 0.002)
    }
    return {
        rate: sorted(int(file.suffix[1:]) for file in files)
        for rate, files in boards.items()
    }


DRILLS = {"failures": failures, "requeue": requeue, "limit": limit, "large": large}


def main():
    """Parse, drill, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=DRILLS, default=list(DRILLS))
    parser.add_argument("--out")
    args = parser.parse_args()
    result = {}
    with tempfile.TemporaryDirectory() as scratch:
        Path(scratch).chmod(0o755)  # munge wants every user to reach its socket
        for name in args.only:
            directory = Path(scratch) / name
            directory.mkdir()
            (directory / "cluster").mkdir()
            with Cluster(directory / "cluster") as cluster:
                result[name] = DRILLS[name](cluster, directory)
            print(json.dumps({name: result[name]}, indent=1), flush=True)
    slurm = subprocess.run(
        ["slurmctld", "-V"], capture_output=True, text=True, check=True
    ).stdout.strip()
    settings = {"job": drills.JOB, "launcher": LAUNCHER, "long": LONG}
    saved = (
        json.loads(Path(args.out).read_text())
        if args.out and Path(args.out).exists()
        else {}
    )
    harness.write(
        args.out,
        saved
        | result
        | {"settings": settings, "slurm": slurm, "machine": harness.machine()},
    )


if __name__ == "__main__":
    main()
