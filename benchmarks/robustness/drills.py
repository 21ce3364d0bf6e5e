"""Kill jobs at random moments until they are done: nothing may be lost or damaged, and the end must be the same.

python -m benchmarks.robustness.drills --out benchmarks/robustness/drills.json     # 200 kills; the same
command again continues What undisturbed jobs leave is the measure, and how long they
take is the latest moment of a kill. After every kill -9 all that counts as written is
read as readers of this package do, also while another process goes on writing. Jobs are
forked from a process that has imported the package, so that kills do not fall into its
import.
"""

import argparse
import hashlib
import importlib
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

SMALL = (
    *(
        "+experiment=smoke",
        "dataset.segments=160",
        "evaluation.episode_s=4",
        "evaluation.systems=[self]",
    ),
    *(
        "training.steps=50",
        "training.log_every=5",
        "training.save_every=5",
        "training.batch=16",
    ),
    *(
        "model.rank=8",
        "model.vertices=3",
        "model.residual_hidden=[8,8]",
        "model.decoder_hidden=[8]",
    ),
    *("model.encoder_hidden=8", "model.embedding=4", "controller.mppi.num_samples=16"),
)
TRAIN = ("train", *SMALL)
CEM = ("controller=cem", "controller.cem.num_samples=16", "controller.cem.elites=4")
DRILLS = {
    # name: (kills, processes at once, whether they start in a run that is trained
    # already)
    "generate": (25, (("generate", *SMALL),), False),
    "two that evaluate": (25, (("evaluate", *SMALL), ("evaluate", *SMALL, *CEM)), True),
    "two that train": (15, (TRAIN, TRAIN), False),
    "train": (40, (TRAIN,), False),
    "sweep": (10, ((*TRAIN, "seed=0,1", "--multirun"),), False),
    "compare": (
        25,
        (
            (
                "compare",
                *SMALL,
                "comparison=tiny",
                "evaluation.systems=[self]",
                "name=table",
            ),
        ),
        False,
    ),
    "certify": (20, (("certify", *SMALL, "certification.renew=true"),), True),
    "evaluate": (20, (("evaluate", *SMALL, *CEM),), True),
    "export": (10, (("export", *SMALL),), True),
    "report": (10, (("report", *SMALL),), True),
}
TIMES = (
    "seconds",
    "seconds_proof",
    "versions",
    "act_ms",
    "root",
    "created",
    "config",
    "made_with",
)
"""Keys of documents that differ between equal runs, or that belong to whoever wrote
last.
"""
BAD, TAKEN = ("sfkd_jax: ", "cannot be read"), "is writing there"
"""What a job says when it fails, or when it cannot read a checkpoint; and when another
process is at work.
"""
COMPILING = {
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
    "XLA_FLAGS": "--xla_backend_optimization_level=0 --xla_cpu_multi_thread_eigen=false",
    "TF_CPP_MIN_LOG_LEVEL": "3",
    "JAX_TRACEBACK_IN_LOCATIONS_LIMIT": "1",
}
"""The last: exported programs record who called, and a job is forked from here and
there in this script.
"""


class Job:
    """A command in a process group of its own, in a folder."""

    def __init__(self, directory, command, output):
        """Fork it; what it says goes into a file."""
        self.command, self.output, self.began, self.status = (
            command,
            directory / output,
            time.monotonic(),
            None,
        )
        self.pid = os.fork()
        if not self.pid:
            self._run(directory)

    def _run(self, directory):
        """What the child does."""
        status = 1
        try:
            os.setsid()
            os.chdir(directory)
            os.dup2(os.open(os.devnull, os.O_RDWR), 0)
            os.dup2(0, 1)
            os.dup2(os.open(self.output, os.O_CREAT | os.O_TRUNC | os.O_WRONLY), 2)
            sys.argv = list(self.command)
            module = importlib.import_module(f"sfkd_jax.{self.command[0]}")
            importlib.import_module("sfkd_jax.cli.entry").hydra_command(module.run)()
            status = 0
        except SystemExit as left:
            status = left.code or 0
        finally:
            os._exit(status)

    def ended(self):
        """Whether it has ended."""
        if self.status is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if pid else None
        return self.status is not None

    def kill(self):
        """kill -9 of the whole group."""
        os.killpg(self.pid, signal.SIGKILL)
        self.status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])

    def lines(self):
        """What it has said."""
        return self.output.read_text().splitlines() if self.output.exists() else []

    def taken(self):
        """Whether it was refused because another process is at work."""
        return self.status == 1 and any(TAKEN in line for line in self.lines())

    def failures(self):
        """Of what it has said, what must not be there; and an exit status that is no
        success and no kill.
        """
        ended = (
            [f"exit status {self.status}: {self.lines()[-1:]}"]
            if self.status not in (0, -signal.SIGKILL)
            else []
        )
        return ended + [
            line for line in self.lines() if any(word in line for word in BAD)
        ]

    def stage(self):
        """What it was at, by what it said last."""
        last = next(
            iter(
                reversed(
                    [line for line in self.lines() if not line.startswith("failed")]
                )
            ),
            "starting",
        )
        words = {
            "generating": "writing data",
            "certificate:": "driving",
            "rmse": "driving",
            "report:": "reporting",
        }
        first = last.split()[0] if last.split() else "starting"
        if (
            first == "training"
        ):  # its last line stays while what is trained is certified
            first = (
                "certifying"
                if f"{'/'.join(last.split()[1:4:2])}" == "50/50"
                else "training"
            )
        return words.get(
            first,
            first
            if first in ("starting", "training", "certifying", "driving")
            else "writing",
        )


def without_times(value):
    """A document less what no two runs share; rows in one order."""
    if isinstance(value, dict):
        value = {
            name: without_times(entry)
            for name, entry in value.items()
            if name not in TIMES
        }
        return (
            value | {"rows": sorted(value["rows"], key=json.dumps)}
            if isinstance(value.get("rows"), list)
            else value
        )
    return (
        [without_times(entry) for entry in value] if isinstance(value, list) else value
    )


def content(file):
    """What a file says, checked as every reader of this package checks it.

    Raises:
        ArtefactError: it is damaged.
    """
    store = importlib.import_module("sfkd_jax.store")
    if file.suffix == ".npz":
        kind = store.read_json(file.with_suffix(".json"), keys=("kind",))["kind"]
        return store.read_arrays(file, kind=kind)[1]["sha256"]
    if file.suffix in (".json", ".jsonl"):
        return without_times(
            store.read_jsonl(file) if file.suffix == ".jsonl" else store.read_json(file)
        )
    return hashlib.sha256(file.read_bytes()).hexdigest()


def files(directory):
    """What counts as written: not checkpoints (the next job tells), boards, pages with
    times in them, hidden files.
    """
    store = importlib.import_module("sfkd_jax.store")
    for file in sorted((directory / "runs").rglob("*")):
        parts = file.relative_to(directory).parts
        skipped = {"checkpoints", "tensorboard", "sweeps"} & set(parts) or any(
            part.startswith(".") for part in parts
        )
        page = file.suffix in (".html", ".md", ".tex", ".gif") or "figures" in parts
        if (
            file.is_file()
            and not skipped
            and not page
            and (file.suffix != ".npz" or store.exists(file))
        ):
            yield file


def damaged(directory):
    """Files that count as written and cannot be read."""
    result = []
    for file in files(directory):
        try:
            content(file)
        except importlib.import_module("sfkd_jax.store").ArtefactError as reason:
            result.append(str(reason))
    return result


def outcome(directory):
    """What finished jobs left: file -> content."""
    return {
        str(file.relative_to(directory)): content(file) for file in files(directory)
    }


def disturbed(directory, commands, moments):
    """Run commands at once; each is killed at its moments [s], one after the other, and given again until it is done.

    Yields:
        A job that has just been killed, or has just ended.
    """
    moments = iter(moments)
    jobs = {
        number: (Job(directory, command, f"said{number}"), next(moments, None))
        for number, command in enumerate(commands)
    }
    while jobs:
        time.sleep(0.01)
        for number, (job, moment) in list(jobs.items()):
            if job.ended():
                del jobs[number]
                yield job
                if job.taken():
                    jobs[number] = Job(directory, job.command, f"said{number}"), moment
            elif moment is not None and time.monotonic() - job.began > moment:
                job.kill()
                yield job
                jobs[number] = (
                    Job(directory, job.command, f"said{number}"),
                    next(moments, None),
                )


def fresh(scratch, name, template):
    """A new folder, with a trained run in it if there is a template."""
    directory = scratch / name.replace(" ", "_")
    shutil.rmtree(directory, ignore_errors=True)
    directory.mkdir()
    if template:
        shutil.copytree(template / "runs", directory / "runs")
    return directory


def undisturbed(scratch, commands, template, known={}):  # noqa: B006, what is measured once serves every drill
    """What jobs leave, one after the other, that nobody kills, and how long the longest takes [s].

    Raises:
        SystemExit: one fails.
    """
    args = tuple(commands)
    while args not in known or len(known[args]) < 2:  # the first ones compile
        directory, longest = (
            fresh(scratch, f"undisturbed{sum(map(len, known.values()))}", template),
            0.0,
        )
        for command in args:
            for job in disturbed(directory, [command], []):
                longest = max(longest, time.monotonic() - job.began)
                if result := job.failures():
                    raise SystemExit("\n".join(result))
        print(
            f"{' and '.join(command[0] for command in args)}: undisturbed {longest:.1f} s",
            flush=True,
        )
        known.setdefault(args, []).append((outcome(directory), longest, directory))
    return known[args][-1]


def drill(name, result, scratch, seed, save):
    """Rounds of jobs, killed until they are done, until the kills are spent; `found`
    grows, and is saved after each.
    """
    kills, commands, trained = DRILLS[name]
    if result["kills"] >= kills:
        return
    template = undisturbed(scratch, (TRAIN,), None)[2] if trained else None
    expected, longest, _ = undisturbed(scratch, dict.fromkeys(commands), template)
    while result["kills"] < kills:
        draw, directory = (
            random.Random(f"{seed} {name} {result['rounds']}"),
            fresh(scratch, name, template),
        )
        planned = min(kills - result["kills"], 3 * len(commands))
        stages, hit = Counter(result["stages"]), 0
        for job in disturbed(
            directory, commands, [draw.uniform(0.0, longest) for _ in range(planned)]
        ):
            if job.status == -signal.SIGKILL:
                stages[job.stage()] += 1
                hit += 1
                result["damaged"] += damaged(directory)
            result["refused"] += job.taken()
            result["failed"] += [] if job.taken() else job.failures()
        left = outcome(directory)
        result["different"] += [
            file
            for file in expected.keys() | left.keys()
            if left.get(file) != expected.get(file)
        ]
        result |= {
            "kills": result["kills"] + hit,
            "stages": dict(stages),
            "undisturbed_s": longest,
        }
        result["rounds"], result["resumed"] = (
            result["rounds"] + 1,
            result["resumed"] + (hit > 0),
        )
        print(json.dumps({name: result}), flush=True)
        save()


def table(document):
    """What was found, as docs/failures.md has it."""
    rows = {
        name: result
        for name, result in document.items()
        if name not in ("settings", "machine")
    }
    counted, listed = (
        ("kills", "rounds", "resumed", "refused"),
        ("damaged", "failed", "different"),
    )
    lines = [
        "| job | kills | rounds | hit | refused | damaged | failed | different |",
        "|---|" + 7 * "---|",
    ]
    for name, group in [(name, [result]) for name, result in rows.items()] + [
        ("all", list(rows.values()))
    ]:
        numbers = [sum(result[key] for result in group) for key in counted]
        numbers += [sum(len(result[key]) for result in group) for key in listed]
        lines.append(f"| {' | '.join(map(str, (name, *numbers)))} |")
    return "\n".join(lines)


def main():
    """Parse, kill, compare, print, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only", choices=DRILLS, action="append", help="of the drills; may be repeated"
    )
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Path(temporary)
        os.environ.update(
            COMPILING
            | {
                "JAX_COMPILATION_CACHE_DIR": str(
                    Path(__file__).parents[2] / ".jax_cache"
                )
            }
        )
        for command in {commands[0][0] for _, commands, _ in DRILLS.values()}:
            importlib.import_module(f"sfkd_jax.{command}")
        timing = importlib.import_module("benchmarks.harness")
        settings = {"seed": args.seed, "jobs": json.loads(json.dumps(DRILLS))}
        document = (
            json.loads(args.out.read_text()) if args.out and args.out.exists() else {}
        )
        if document.get("settings") != settings:
            document = {"settings": settings}
        empty = {"kills": 0, "rounds": 0, "resumed": 0, "refused": 0, "stages": {}}

        def save():
            timing.write(args.out, document | {"machine": timing.machine()})

        for name in args.only or DRILLS:
            result = document.setdefault(
                name, empty | {key: [] for key in ("damaged", "failed", "different")}
            )
            drill(name, result, scratch, args.seed, save)
        print(table(document), flush=True)


if __name__ == "__main__":
    main()
