"""Kill jobs at random moments until they are done: nothing may be lost or damaged, and the end must be the same.

python benchmarks/drills.py [--kills 50 --longest 25 --seed 0 --out benchmarks/drills.json]
A job is the whole walk of `train +experiment=smoke`: data, training, certificate, drives, report. What an undisturbed
job leaves is the measure. After every kill -9 all that counts as written is read as readers of this package do.
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
from pathlib import Path

import timing

from sfkd_jax import artefacts

JOB = (
    "+experiment=smoke",
    "training.steps=50",
    "training.save_every=5",
    "dataset.segments=160",
    "evaluation.episode_s=4",
)
SAME = ("policy.npz", "certificate.json", "open_loop.json", "results.json", "episodes.npz")
TIMES = ("seconds", "versions", "act_ms", "root")
"""Keys of documents that differ between equal runs."""


def start(place):
    """The job in a process group of its own."""
    command = [sys.executable, "-m", "sfkd_jax.train", *JOB]
    return subprocess.Popen(
        command, cwd=place, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
    )


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
    return without_times(artefacts.read_json(file))


def damaged(place):
    """Files that count as written and cannot be read; checkpoints have a library of their own."""
    found = []
    for file in sorted((place / "runs").rglob("*")):
        written = artefacts.exists(file) if file.suffix == ".npz" else file.suffix == ".json"
        if not written or file.name.startswith(".") or "checkpoints" in file.parts:
            continue
        try:
            content(file)
        except artefacts.ArtefactError as reason:
            found.append(str(reason))
    return found


def outcome(place):
    """What a finished job left."""
    run = place / "runs/smoke/sfkd/seed=0"
    return {name: content(run / name) for name in SAME}


def disturbed(place, draw, longest, left):
    """Kill a job until it is done or `left` kills are spent: kills, whether it was done, damage, failures."""
    kills, damage, failures = 0, [], []
    while True:
        job, began = start(place), time.monotonic()
        try:
            error = job.communicate(timeout=draw.uniform(0.0, longest) if kills < left else None)[1]
        except subprocess.TimeoutExpired:
            os.killpg(job.pid, signal.SIGKILL)
            job.communicate()
            kills += 1
            damage += damaged(place)
            continue
        if job.returncode:
            failures.append(f"after {time.monotonic() - began:.0f} s: {error.decode().splitlines()[-1]}")
        return kills, damage, failures


def main():
    """Parse, kill, compare, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, value in (("kills", 50), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--longest", type=float, default=25.0, help="seconds until a kill, at most")
    parser.add_argument("--out")
    asked = parser.parse_args()
    draw, kills, jobs, damage, failures, other = random.Random(asked.seed), 0, 0, [], [], []
    with tempfile.TemporaryDirectory() as scratch:
        place = Path(scratch, "undisturbed")
        place.mkdir()
        start(place).communicate()
        expected = outcome(place)
        while kills < asked.kills:
            place, jobs = Path(scratch, str(jobs)), jobs + 1
            place.mkdir()
            count, broken, failed = disturbed(place, draw, asked.longest, asked.kills - kills)
            kills, damage, failures = kills + count, damage + broken, failures + failed
            if not failed:
                found = outcome(place)
                other += [name for name in SAME if found[name] != expected[name]]
            print(f"{kills} kills, {jobs} jobs, {len(damage)} damaged, {len(failures)} failed, {other}", flush=True)
    document = {"kills": kills, "jobs": jobs, "damaged": damage, "failed": failures, "different": other}
    settings = {key: getattr(asked, key) for key in ("kills", "longest", "seed")}
    timing.write(asked.out, document | {"settings": settings, "machine": timing.machine()})
    print(json.dumps(document))


if __name__ == "__main__":
    main()
