"""A seeded fuzzer of all files that this package reads.

    python tests/fuzzing.py --cases 10000 --seed 0

Each case changes one file of a valid folder and reads the folder as the package does.
There are two valid outcomes: the content is read correctly, or the file is refused in
one line that names it. A case that takes longer than SECONDS, allocates more than 1 GiB
or raises anything else is a fault. A case is a function of (seed, reader, number) and
can be run alone:  --only read_json --case 17
"""

import argparse
import json
import os
import random
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import fuzzing_readers as readers
from fuzzing_mutations import put_special_file

MEMORY_DISK = Path("/dev/shm")
"""Directory of the folders if it exists; writing to a disk takes longer than reading."""
SECONDS = 30
"""Time limit of a case; the slowest valid one takes 0.3 s on an idle machine."""
MEMORY = 1 << 30
"""Address space that a case may allocate [bytes]."""
SPECIAL = 0.02
"""Share of cases in which a pipe, a device, a folder, a socket or a link replaces the
file.
"""
SHARES = {
    "read_json": 25,
    "read_jsonl": 12,
    "read_arrays": 26,
    "read_npz": 12,
    "log_csv": 4,
    "log_npz": 4,
    "log_parquet": 2,
    "merge": 6,
    "report": 3,
    "benchmark": 2,
    "comparison": 2,
    "exported": 1,
    "load": 1,
}
"""Cases of 100; readers that draw, compile or import a library get fewer."""


class Hang(BaseException):
    """A case that took too long."""


def fault_of(
    reader: readers.Reader, folder: Path, changed: str
) -> tuple[str, str | None]:
    """The outcome of reading a folder in which one file was changed, and what is wrong
    with it.
    """
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        result = reader.read(folder)
        signal.setitimer(signal.ITIMER_REAL, 0)
        if not reader.holds(result, folder):
            return "changed", "accepted, but means something else"
    except reader.refusals as reason:
        line = str(reason)
        if type(reason) not in reader.refusals:
            return "leaked", f"{type(reason).__name__}: {line[:200]}"
        if len(line.splitlines()) != 1 or len(line) > 2000 or not line.isprintable():
            return "leaked", f"not one line: {line[:200]!r}"
        named = (
            any(file.stem in line for file in folder.rglob("*"))
            or Path(changed).stem in line
        )
        return (
            ("refused", None) if named else ("leaked", f"names no file: {line[:200]}")
        )
    except Hang:
        return "hung", f"more than {SECONDS} s"
    except BaseException as reason:
        return "leaked", f"{type(reason).__name__}: {str(reason)[:200]}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "accepted", None


def restore(folder: Path, sound: dict[str, bytes]) -> None:
    """Put back what was there, and nothing else; what reading changed counts as well."""
    for path in sorted(folder.rglob("*"), reverse=True):
        name = path.relative_to(folder).as_posix()
        if name in sound and path.is_file() and not path.is_symlink():
            continue
        if path.is_symlink() or not path.is_dir():
            path.unlink()
        elif not any(stored.startswith(f"{name}/") for stored in sound):
            path.rmdir()
    for name, content in sound.items():
        if not (folder / name).exists() or (folder / name).read_bytes() != content:
            (folder / name).write_bytes(content)


def fuzz(
    name: str, numbers: range, seed: int
) -> tuple[Counter, list[dict[str, Any]], float]:
    """Cases of one reader: outcomes, faults, seconds of the slowest."""
    reader, outcomes, faults, slowest = readers.READERS[name], Counter(), [], 0.0
    with tempfile.TemporaryDirectory(
        dir=MEMORY_DISK if MEMORY_DISK.is_dir() else None
    ) as run_dir:
        folder = Path(run_dir)
        reader.make(folder)
        sound = {
            file.relative_to(folder).as_posix(): file.read_bytes()
            for file in folder.rglob("*")
            if file.is_file()
        }
        reader.read(folder)  # what is imported and compiled once has no limit of time
        assert fault_of(reader, folder, "nothing") == ("accepted", None), (
            f"{name} refuses what is sound"
        )
        for number in numbers:
            restore(folder, sound)
            draw = random.Random(f"{seed}/{name}/{number}")
            file = draw.choice(list(reader.files))
            if draw.random() < SPECIAL:
                put_special_file(draw, folder / file)
            else:
                (folder / file).write_bytes(reader.files[file](draw, sound[file]))
            began = time.monotonic()
            outcome, fault = fault_of(reader, folder, file)
            slowest = max(slowest, time.monotonic() - began)
            outcomes[outcome] += 1
            if fault:
                faults.append(
                    {
                        "reader": name,
                        "case": number,
                        "file": file,
                        "fault": fault.replace(run_dir, ""),
                    }
                )
    return outcomes, faults, slowest


def shares(cases: int, chosen: dict[str, int]) -> dict[str, int]:
    """How many cases each reader gets."""
    return {
        name: max(1, cases * share // sum(chosen.values()))
        for name, share in chosen.items()
    }


def bound_memory() -> None:
    """From here on, an allocation beyond MEMORY fails."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, resource.RLIM_INFINITY))


def main() -> None:
    """Run, and print what came of it as one JSON object."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", default=10_000, type=int)
    parser.add_argument("--seed", default=0, type=int)
    parser.add_argument("--only", choices=list(SHARES))
    parser.add_argument("--case", type=int)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"

    def expire(*_: Any) -> None:
        raise Hang

    signal.signal(signal.SIGALRM, expire)
    counts = (
        {options.only: options.cases} if options.only else shares(options.cases, SHARES)
    )
    for (
        name
    ) in counts:  # what is imported, compiled or cached once is no allocation of a case
        fuzz(name, range(-1, 0), options.seed)
    bound_memory()
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    result: dict[str, Any] = {"readers": {}, "faults": []}
    for name, count in counts.items():
        started = time.monotonic()
        numbers = (
            range(count)
            if options.case is None
            else range(options.case, options.case + 1)
        )
        outcomes, faults, slowest = fuzz(name, numbers, options.seed)
        seconds = {
            "slowest_s": round(slowest, 3),
            "seconds": round(time.monotonic() - started, 1),
        }
        result["readers"][name] = {"cases": len(numbers), **outcomes, **seconds}
        result["faults"] += faults
        print(name, result["readers"][name], file=sys.stderr, flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result |= {
        "cases": sum(entry["cases"] for entry in result["readers"].values()),
        "seed": options.seed,
    }
    result |= {
        "memory_MiB": {
            "before": before >> 10,
            "grown_by": (peak - before) >> 10,
            "bound": MEMORY >> 20,
        }
    }
    result |= {
        "seconds": round(time.monotonic() - began, 1),
        "processor_s": round(time.process_time(), 1),
    }
    print(json.dumps(result), flush=True)
    sys.exit(1 if result["faults"] else 0)


if __name__ == "__main__":
    main()
