"""Mutation tests of the files behind a certificate: how many mutants the tests notice.

    pip install cosmic-ray
    python -m benchmarks.robustness.mutants [--files _core _claims] [--only named:]
        [--jobs 2] [--out benchmarks/robustness/mutants.json]

cosmic-ray, which the package does not need, makes the mutants: each changes one
operator, number, condition, loop or exception. Mutants are left out if they change
annotations, use operators that numbers do not have (`%`, `<<`, `|` … for `+`, which
nearly all end in a TypeError and flatter the share), compare numbers with `is`, or
change the `*` before keyword-only arguments. `NAMED` adds mistakes that no single
operator makes; the tests must notice all of them.

Every mutant runs in a fork of a process that has imported everything and collected the
tests once, which takes a tenth of a second instead of four. Rows of the output for
other files stay as they are.
"""

import argparse
import ast
import hashlib
import importlib
import json
import os
import resource
import sys
import time
from collections import Counter
from itertools import count, zip_longest
from pathlib import Path

for _library in ("OPENBLAS", "OMP", "MKL"):  # a fork does not copy threads
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import pytest  # noqa: E402
from _pytest.runner import runtestprotocol  # noqa: E402
from cosmic_ray.mutating import mutate_code  # noqa: E402
from cosmic_ray.operators.provider import OperatorProvider  # noqa: E402

from benchmarks.robustness.named_mutants import ARGUED, FILES, NAMED  # noqa: E402
from sfkd_jax import certification, store  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SOURCES = Path(certification.__file__).parent
TESTS = ROOT / "tests" / "certification"
SLOW = "thousands"
"""Part of the names of slow tests, which run last."""
ARITHMETIC = {
    "Add": "Sub",
    "Sub": "Add",
    "Mul": "Div",
    "Div": "Mul",
    "FloorDiv": "Mul",
    "Mod": "Add",
    "Pow": "Mul",
}
UNARGUED = "not argued"
SECONDS = 60
"""Limit on processor time; a mutant that takes longer counts as noticed."""


def mutants_of(name):
    """Return (description, source) of every mutant of a file that computes something
    else.
    """
    source = (SOURCES / f"{name}.py").read_text("utf-8")
    mutants = [*named_mutants(name, source), *operator_mutants(source)]
    seen, distinct = {_computes(source)}, []
    for description, mutant in mutants:
        try:
            tree = _computes(mutant)
        except SyntaxError:
            continue
        if tree not in seen:
            distinct.append((description, mutant))
        seen.add(tree)
    return distinct


def named_mutants(name, source):
    """Yield the mutants in `NAMED`."""
    for text, replacement in NAMED[name]:
        assert source.count(text) == 1, f"{name}: {text!r} must occur once"
        yield f"named: {text.strip()}", source.replace(text, replacement)


def operator_mutants(source):
    """Yield the mutants of cosmic-ray."""
    provider = OperatorProvider()
    for operator in provider:
        first, second = [*operator.split("_"), "", ""][1:3]
        skip = operator.startswith("Variable") or second in ("Invert", "Not")
        if operator.startswith("ReplaceBinary"):
            skip |= ARITHMETIC.get(first) != second
        if operator.startswith("ReplaceComparison"):
            skip |= second.startswith("Is") and not first.startswith("Is")
        if skip:
            continue
        for occurrence in count():
            mutant = mutate_code(source, provider[operator](), occurrence)
            if mutant is None:
                break
            yield f"{operator}: {_difference(source, mutant)}", mutant


def _computes(source):
    """Return the syntax tree without annotations and marks of keyword-only arguments."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(0)
        if isinstance(node, ast.arg):
            node.annotation = None
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        if isinstance(node, ast.arguments):  # cosmic-ray takes the `*` for a product
            defaults = [value for value in node.kw_defaults if value]
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.defaults = [*node.defaults, *defaults]
            node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
    return ast.dump(tree)


def _difference(source, mutant):
    """Return number and text of the first changed line of a mutant."""
    lines = zip(source.splitlines(), mutant.splitlines(), strict=False)
    return next(
        (f"{k}: {new.strip()}" for k, (old, new) in enumerate(lines, 1) if old != new),
        "a line less",
    )


def mutate(name, mutant):
    """Replace a module by a mutant, also where its functions were imported."""
    module = importlib.import_module(f"sfkd_jax.certification.{name}")
    before = dict(vars(module))
    source = (SOURCES / f"{name}.py").read_text("utf-8")
    exec(compile(mutant, module.__file__, "exec"), vars(module))
    for key, new in list(vars(module).items()):
        old = before.get(key, new)
        if isinstance(old, type) and _class_of(source, key) == _class_of(mutant, key):
            setattr(module, key, old)  # others hold instances of it
        elif new is not old:
            for other in list(sys.modules.values()):
                if other is not None and getattr(other, "__dict__", {}).get(key) is old:
                    setattr(other, key, new)


def _class_of(source, name):
    """Return the syntax tree of a class in a source, or nothing."""
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef) and node.name == name:
            return ast.dump(node)
    return ""


def notices(items, name, mutant):
    """Fork, mutate a module, run the tests up to the first failure; return the pid."""
    if child := os.fork():
        return child
    status = 1
    try:
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        mutate(name, mutant)
        for item, following in zip_longest(items, items[1:]):
            if any(
                report.failed
                for report in runtestprotocol(item, nextitem=following, log=False)
            ):
                break
        else:
            status = 0
    except BaseException:  # a mutant that cannot be imported is noticed
        status = 1
    os._exit(status)


class Mutate:
    """A pytest plugin that runs the tests once for every mutant."""

    def __init__(self, jobs, files, only):
        self.jobs, self.files, self.only, self.rows = jobs, files, only, {}

    def pytest_runtestloop(self, session):
        """Count the mutants of every file. This process runs no test, so that no thread
        of an accelerator's library exists when it forks.
        """
        for name, files in FILES.items():
            if name in self.files:
                items = [item for item in session.items if item.path.name in files]
                items.sort(
                    key=lambda item: (SLOW in item.name, files.index(item.path.name))
                )
                self.rows[name] = self.count(name, items)
        return True

    def count(self, name, items):
        """Return the numbers of mutants and survivors of a file, and these by name."""
        source = (SOURCES / f"{name}.py").read_text("utf-8")
        if os.waitpid(notices(items, name, source), 0)[1]:
            raise SystemExit(f"the tests of {name} fail without a mutant")
        mutants = [row for row in mutants_of(name) if self.only in row[0]]
        survivors = self.survivors(name, items, mutants)
        return {
            "total": len(mutants),
            "killed": len(mutants) - len(survivors),
            "named": len(NAMED[name]),
            "survived": {survivor: reason(survivor) for survivor in sorted(survivors)},
            "sha256": hashlib.sha256(source.encode()).hexdigest(),
        }

    def survivors(self, name, items, mutants):
        """Run the tests for all mutants; return the descriptions of the survivors."""
        waiting, running, survivors = mutants[::-1], {}, []
        while waiting or running:
            while waiting and len(running) < self.jobs:
                description, mutant = waiting.pop()
                running[notices(items, name, mutant)] = description
            child, status = os.wait()
            description = running.pop(child)
            if status == 0:
                survivors.append(description)
                print(f"{name} survives: {description}", flush=True)
        return survivors


def reason(survivor):
    """Return why a survivor accepts no false claim."""
    for argument, texts in ARGUED.items():
        if any(text in survivor for text in texts):
            return argument
    return UNARGUED


def main():
    """Count mutants, print the numbers and write them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", nargs="+", choices=FILES, default=list(FILES))
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--only", default="", help="part of the mutant's description")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    began = time.perf_counter()
    plugin = Mutate(options.jobs, options.files, options.only)
    tests = sorted(
        {str(TESTS / test) for name in options.files for test in FILES[name]}
    )
    # addopts is empty, so types are not checked: a mutant must be noticed by a value.
    arguments = [
        "-q",
        "-p",
        "no:cacheprovider",
        "-o",
        "addopts=",
        "--rootdir",
        str(ROOT),
    ]
    status = pytest.main([*arguments, *tests], [plugin])
    if status or set(plugin.rows) != set(options.files):
        sys.exit(f"pytest ended with {status}")
    counts = {
        name: {key: row[key] for key in ("total", "killed")}
        for name, row in plugin.rows.items()
    }
    print(json.dumps({**counts, "seconds": round(time.perf_counter() - began)}))
    reasons = Counter(
        reason for row in plugin.rows.values() for reason in row["survived"].values()
    )
    print(json.dumps(reasons, indent=1))
    if options.out:
        write(options.out, plugin.rows)
    sys.exit(1 if reasons[UNARGUED] else 0)


def write(path, rows):
    """Write the counts; rows of other files in the document stay."""
    known = store.read_json(path)["files"] if path.exists() else {}
    rows = known | rows
    document = {
        "files": {name: rows[name] for name in FILES if name in rows},
        "versions": store.versions(),
    }
    store.write_json(path, document)


if __name__ == "__main__":
    main()
