"""Kill jobs at random moments until they are done: nothing may be lost or damaged, and the end must be the same.

python benchmarks/drills.py [--kills 50 --sweep-kills 10 --seed 0 --out benchmarks/drills.json]
A job is the whole walk of `train +experiment=smoke`, made small: data, training, certificate, drives, report; a sweep
is two of them. What an undisturbed job leaves is the measure, and how long it takes is the latest moment of a kill.
After every kill -9 all that counts as written is read as readers of this package do.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import timing

from sfkd_jax import artefacts

JOB = (
    *("+experiment=smoke", "dataset.segments=160", "evaluation.episode_s=4", "evaluation.systems=[self,nominal]"),
    *("training.steps=50", "training.log_every=5", "training.save_every=5", "training.batch=16"),
    *("model.rank=8", "model.vertices=3", "model.residual_hidden=[8,8]", "model.decoder_hidden=[8]"),
    *("model.encoder_hidden=8", "model.embedding=4", "controller.mppi.num_samples=16"),
)
SWEEP = (*JOB, "seed=0,1", "--multirun")
SAME = ("policy.npz", "certificate.json", "open_loop.json", "results.json", "episodes.npz", "metrics.jsonl")
TIMES = ("seconds", "seconds_proof", "versions", "act_ms", "root")
"""Keys of documents that differ between equal runs."""
BAD = ("sfkd_jax: ", "cannot be read")
"""What a job says when it fails, or when it cannot read a checkpoint."""


class Job:
    """A walk in a process group of its own, in a folder."""

    def __init__(self, place, options, cache):
        """Start it; what it compiles is kept in `cache` for the next one."""
        settings = {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        settings |= {"JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1", "TF_CPP_MIN_LOG_LEVEL": "3"}
        settings |= {"XLA_FLAGS": "--xla_backend_optimization_level=0"}
        self.place, self.began = place, time.monotonic()
        self._said = (place / "said.txt").open("w+")  # a file: no pipe that has to be emptied
        command = [sys.executable, "-m", "sfkd_jax.train", *options]
        nothing, env = subprocess.DEVNULL, os.environ | settings
        self.process = subprocess.Popen(
            command, cwd=place, env=env, stdin=nothing, stdout=nothing, stderr=self._said, start_new_session=True
        )

    def wait(self, seconds=None):
        """Whether it ended within so many seconds."""
        try:
            self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self):
        """kill -9 of the whole group."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def lines(self):
        """What it has said."""
        return (self.place / "said.txt").read_text().splitlines()

    def failures(self):
        """Of what it has said, what must not be there; and an exit status that is no success and no kill."""
        status = self.process.returncode
        ended = [f"exit status {status}: {self.lines()[-1:]}"] if status not in (0, -signal.SIGKILL) else []
        return ended + [line for line in self.lines() if any(word in line for word in BAD)]

    def stage(self, starting):
        """What a job that ran so long was at: by what lies there, and by what it said last."""
        last = next(iter(reversed(self.lines())), "")
        if time.monotonic() - self.began < starting:
            return "starting"
        if last.startswith("driving") or last.startswith("  rmse") or last.startswith("certificate"):
            return "driving"
        if last.startswith("report"):
            return "reporting"
        if not any((self.place / "runs" / "datasets").glob("*/dataset.json")):
            return "writing data"
        began = [line.split(", in ")[1] for line in self.lines() if line.startswith("training") and ", in " in line]
        return "training" if began and not (self.place / began[-1] / "policy.json").exists() else "certifying"


def without_times(value):
    """A document less what no two runs share."""
    if isinstance(value, dict):
        return {name: without_times(entry) for name, entry in value.items() if name not in TIMES}
    return [without_times(entry) for entry in value] if isinstance(value, list) else value


def content(file):
    """What a file says, checked as every reader of this package checks it.

    Raises:
        ArtefactError: it is damaged.
    """
    if file.suffix == ".npz":
        kind = artefacts.read_json(file.with_suffix(".json"), keys=("kind",))["kind"]
        return artefacts.read_arrays(file, kind=kind)[1]["sha256"]
    return without_times(artefacts.read_jsonl(file) if file.suffix == ".jsonl" else artefacts.read_json(file))


def damaged(place):
    """Files that count as written and cannot be read; of checkpoints the next job tells."""
    found = []
    for file in sorted((place / "runs").rglob("*")):
        written = artefacts.exists(file) if file.suffix == ".npz" else file.suffix in (".json", ".jsonl")
        if not written or file.name.startswith(".") or "checkpoints" in file.parts:
            continue
        try:
            content(file)
        except artefacts.ArtefactError as reason:
            found.append(str(reason))
    return found


def outcome(place):
    """What a finished job left: file -> content, of every seed."""
    runs = sorted((place / "runs/smoke/sfkd").glob("seed=*"))
    return {f"{run.name}/{name}": content(run / name) for run in runs for name in SAME}


def undisturbed(place, options, cache):
    """What a job leaves that nobody kills, and how long it takes until it says something, and in all [s].

    Raises:
        SystemExit: it fails.
    """
    for _ in range(2):  # the first one compiles
        place = place.with_name(f"{place.name}_")
        place.mkdir()
        job = Job(place, options, cache)
        while not job.lines() and not job.wait(0.05):
            pass
        starting = time.monotonic() - job.began
        job.wait()
        if found := job.failures():
            raise SystemExit("\n".join(found))
        print(f"undisturbed: {time.monotonic() - job.began:.0f} s", flush=True)
    return outcome(place), starting, time.monotonic() - job.began


def drill(name, options, kills, draw, scratch):
    """Jobs, each killed until it is done, until the kills are spent: what was found."""
    cache = str(scratch / "cache")
    expected, starting, longest = undisturbed(scratch / name, options, cache)
    stages, found = Counter(), {"jobs": 0, "resumed": 0, "damaged": [], "failed": [], "different": []}
    while stages.total() < kills:
        place, disturbed, done = scratch / f"{name}{found['jobs']}", 0, False
        place.mkdir()
        while not done:
            job = Job(place, options, cache)
            done = job.wait(draw.uniform(0.0, longest) if stages.total() < kills else None)
            if not done:
                stages[job.stage(starting)] += 1
                job.kill()
                disturbed += 1
                found["damaged"] += damaged(place)
            found["failed"] += job.failures()
            print(f"{name}: job {found['jobs']}, {stages.total()} kills, {dict(stages)}", flush=True)
        found["jobs"], found["resumed"] = found["jobs"] + 1, found["resumed"] + (disturbed > 0)
        try:
            left = outcome(place)
            found["different"] += [file for file in expected if left.get(file) != expected[file]]
        except artefacts.ArtefactError as reason:
            found["failed"].append(str(reason))
    found = {"kills": stages.total(), "stages": dict(stages), "undisturbed_s": longest} | found
    print(json.dumps({name: found}), flush=True)
    return found


def main():
    """Parse, kill, compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("kills", 50), ("sweep-kills", 10), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--out")
    asked = parser.parse_args()
    jobs = {"walk": (JOB, asked.kills), "sweep": (SWEEP, asked.sweep_kills)}
    with tempfile.TemporaryDirectory() as scratch:
        found = {
            name: drill(name, options, kills, random.Random(asked.seed), Path(scratch))
            for name, (options, kills) in jobs.items()
            if kills
        }
    document = found | {"settings": vars(asked) | {"job": JOB}, "machine": timing.machine()}
    document["settings"].pop("out")
    timing.write(asked.out, document)


if __name__ == "__main__":
    main()
