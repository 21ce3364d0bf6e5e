"""Change what certificates rest on in one place at a time, and count the changes that its tests notice.

pip install cosmic-ray  (it makes the mutants; it is no dependency of the package)
python -m benchmarks.robustness.mutants [--files _core _claims --jobs 2 --out benchmarks/robustness/mutants.json]
Every mutant runs in a fork of a process that has imported everything and collected the tests once: a tenth of a second
instead of four. Mutants are made by cosmic-ray; left out are those of annotations, operators that numbers do not have
(`%`, `<<`, `|` … for `+`: nearly all die of a TypeError, which flatters the share), `is` between numbers, and the `*`
before arguments that are given by name. What the document has of files that were not asked for stays in it.
`NAMED` are mistakes that no single operator makes; they must all die.
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
from itertools import zip_longest
from pathlib import Path

for _library in ("OPENBLAS", "OMP", "MKL"):  # a fork takes no threads along
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import pytest  # noqa: E402
from _pytest.runner import runtestprotocol  # noqa: E402
from cosmic_ray.mutating import mutate_code  # noqa: E402
from cosmic_ray.operators.provider import OperatorProvider  # noqa: E402

from sfkd_jax import artefacts, certification  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
SOURCES = Path(certification.__file__).parent
TESTS = ROOT / "tests" / "certification"
FILES = {
    "_core": ["test_core_bounds.py", "test_core.py"],
    "_claims": ["test_forgeries.py"],
    "_certificate": ["test_forged_certificates.py"],
    "_calibration": ["test_calibration.py"],
    "_document": ["test_document_arithmetic.py"],
    "_output_metrics": ["test_output_claims.py"],
    "_corridor_claims": ["test_corridor_claims.py"],
}
SLOW = "thousands"
"""Tests of seconds come last: few mutants reach them."""
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
"""Of processor time; a mutant that takes longer counts as noticed."""
NAMED = {
    "_core": [
        ("+ rounding\n    return bool(rest", "\n    return bool(rest"),
        (
            "rest * (1 + MARGIN) + error + lost < shift",
            "0.5 * rest + error + lost < shift",
        ),
        (
            "return left @ right, error + left.size * right.shape[1] * TINY",
            "return left @ right, 0.0",
        ),
        (
            "is_positive_definite(*witness_matrix(",
            "is_positive_definite(witness_matrix(",
        ),
        ("bound, vertex, metric))\n", "bound, vertex, metric)[0])\n"),
        (
            "4 * UNIT * (frobenius(squared) + frobenius(start) + frobenius(matrix))",
            "4 * UNIT * frobenius(squared)",
        ),
        ("4 * UNIT * size * largest)", "0.0)"),
        (
            "[()] * len(operators), rate, operators, metric)",
            "[()], rate, operators[:1], metric)",
        ),
        (
            "in zip(witnesses, vertices, strict=True)",
            "in list(zip(witnesses, vertices, strict=True))[:1]",
        ),
        ("fits = len(witnesses) == len(vertices) and all(", "fits = all("),
        (" and not is_positive_definite(metric)", " and False"),
    ],
    "_claims": [
        ("for vertex in operators.vertices)", "for vertex in operators.vertices[:1])"),
        (
            'zip(seen["joint"], operators.vertices, strict=True)',
            'zip(seen["joint"][:1], operators.vertices[:1])',
        ),
        (
            'for part, vertex in zip(seen["joint"], operators.vertices, strict=True)',
            'for part, vertex in zip(seen["joint"], operators.vertices)',
        ),
        (' and weights.declared.transport == "identity"', ""),
        ('checks["scope"] = claims.scope == scope', 'checks["scope"] = True'),
        (
            'checks["kappa"] = claims.kappa == 1.0 if metric is None else claims.kappa >= 1.0',
            "",
        ),
        ("claims.beta * claims.kappa**0.5", "claims.beta"),
    ],
    "_certificate": [
        ("not claims.alpha < 1.0 or ", ""),
        (" or certificate.transport_lipschitz != 1.0", ""),
        (
            "    _require_consistent(certificate, claims, weights)\n    except",
            "    pass\n    except",
        ),
        ("claims_hold(claims, weights, certificate.env_box)", "pass"),
    ],
    "_calibration": [
        (
            "conformal_quantile(np.max(calibration.scores / units, axis=1), level)",
            "float(np.quantile(np.max(calibration.scores / units, axis=1), level))",
        ),
        ("held_out.scores <= bounds", "held_out.scores[:, :1] <= bounds[:1]"),
    ],
    "_document": [
        ("    verify(proof, params, model=model, weights=weights)\n", ""),
        ('        _require_tubes(document["tube"], proof, document["d_bar"])\n', ""),
        ('{"d_bar": d_bar, **d_bar["by_scenario"]}', '{"d_bar": d_bar}'),
        (' or not supports(d_bar["trajectories"], level)', ""),
        ("<= REPEATED * np.abs(expected)", "<= REPEATED + REPEATED * np.abs(expected)"),
    ],
    "_output_metrics": [
        (
            "claim.joint, claim.alpha, list(vertices), claim.metric",
            "claim.joint, claim.alpha, list(vertices)",
        ),
        (
            "claim.joint, claim.alpha, list(vertices),",
            "claim.joint[:1], claim.alpha, list(vertices)[:1],",
        ),
        ("is_positive_definite(matrix, error)", "is_positive_definite(matrix)"),
        ("error = rounding + ", "error = "),
        ("name not in OUTPUTS or not may_have_metrics(weights)", "name not in OUTPUTS"),
    ],
    "_corridor_claims": [
        ('expected = bounds["nominal"] + bounds', "expected = bounds"),
        ('{"corridor": corridor, **corridor["by_scenario"]}', '{"corridor": corridor}'),
        (" and supports(drives, level)", ""),
        (
            '    require_fixed_points(corridor["fixed_points"], output, bounds["for_ever_position"])\n',
            "",
        ),
        (
            "for name in JOINT], axis=0)\n    factor",
            "for name in JOINT[:1]], axis=0)\n    factor",
        ),
    ],
}
"""Of each file: text and what replaces it."""
ARGUED = {
    "what passes is refused by the comparison beside it, or by the core": (
        *("<= error != np.inf", "< bound != np.inf", "<= condition != np.inf"),
        *("<= value != math.inf", "< value != math.inf", "exact = -1 <= inside"),
        *(
            "largest <= np.inf and",
            "largest != np.inf and",
        ),  # the rest contains the entry that is not finite
        "zip(witnesses, vertices, strict=False)",
        *(
            "claims.kappa != 1.0",
            "claims.kappa > 1.0",
            "claims.kappa >= 0.0",
        ),  # with P the core proves no κ ≤ 1
        *(
            "< level != 1",
            "< level <= 1",
            "< level < 2",
        ),  # no number of trajectories supports such a level
    ),
    "norms and scores are never negative: ≠ 0 is > 0": (
        "SMALLEST != 0",
        "largest != 0",
        "found != 0",
    ),
    "the same norm by the other of two formulas": (
        *(
            "1e-140 == size",
            "size == 1e140",
            "1e-140 <= size",
            "size <= 1e140",
            "if 1.0 < size",
        ),
    ),
    "the only entry of a list, one of several alike, or the first of two words": (
        *(
            'seen["joint"][ -1]',
            "weights.operators[ -1]",
            "witness[ -1]",
            "witness[0][ -1]",
        ),
        *('mode <= "joint"', "if name <= JOINT[0]"),
    ),
    "nothing that is proved or measured depends on it": (
        *(
            "np.nextafter(0.0, 2.0)",
            "initial= -1.0",
            "largest, physical, always = 1.0",
            "strict=False)])",
        ),
        *(
            "CHUNK = ",
            "-(-count * CHUNK) * CHUNK",
            "RemoveDecorator: 42: def _largest",
        ),  # sizes of batches, compilation
    ),
}
"""Why a change that is not noticed accepts nothing more: reason -> what such changes
look like.
"""


def mutants_of(name):
    """What was changed, and the changed source, of each mutant that computes something
    else.
    """
    source = (SOURCES / f"{name}.py").read_text("utf-8")
    seen, found, provider = {_computes(source)}, [], OperatorProvider()
    for old, new in NAMED.get(name, []):
        assert source.count(old) == 1, (
            f"{name}: {old!r} is there {source.count(old)} times"
        )
        found.append((f"named: {old.strip()}", source.replace(old, new)))
    for operator in provider:
        first, second = [*operator.split("_"), "", ""][1:3]
        skip = operator.startswith("Variable") or second in ("Invert", "Not")
        skip |= operator.startswith("ReplaceBinary") and ARITHMETIC.get(first) != second
        skip |= (
            operator.startswith("ReplaceComparison")
            and second.startswith("Is")
            and not first.startswith("Is")
        )
        count = 0
        while (
            not skip
            and (mutant := mutate_code(source, provider[operator](), count)) is not None
        ):
            found.append((f"{operator}: {_difference(source, mutant)}", mutant))
            count += 1
    fresh = []
    for what, mutant in found:
        try:
            tree = _computes(mutant)
        except SyntaxError:  # no program
            continue
        if tree not in seen:
            fresh.append((what, mutant))
        seen.add(tree)
    return fresh


def _computes(source):
    """The tree of what runs: without annotations, and without what may be handed over
    by name only.
    """
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(0)
        if isinstance(node, ast.arg):
            node.annotation = None
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        if isinstance(
            node, ast.arguments
        ):  # the `*` between them is taken for a product
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.defaults = [
                *node.defaults,
                *(value for value in node.kw_defaults if value),
            ]
            node.posonlyargs, node.kwonlyargs, node.kw_defaults = [], [], []
    return ast.dump(tree)


def _difference(source, mutant):
    """The first line that changed, as it is now."""
    lines = zip(source.splitlines(), mutant.splitlines(), strict=False)
    return next(
        (f"{k}: {new.strip()}" for k, (old, new) in enumerate(lines, 1) if old != new),
        "a line less",
    )


def mutate(name, mutant):
    """Run the changed source in place of the module, and hand the new functions to
    whoever took the old ones.
    """
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
    """A class in a source, as a tree."""
    found = [
        node
        for node in ast.parse(source).body
        if isinstance(node, ast.ClassDef) and node.name == name
    ]
    return ast.dump(found[0]) if found else ""


def notices(items, name, mutant):
    """Start a fork in which one module is mutated and the tests run up to the first
    that fails: its process id.
    """
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
    except BaseException:  # a mutant that cannot even be imported is noticed
        status = 1
    os._exit(status)


class Mutate:
    """In place of the loop that runs the tests, one that does so for each mutant."""

    def __init__(self, jobs, files, only):
        self.jobs, self.files, self.only, self.found = jobs, files, only, {}

    def pytest_runtestloop(self, session):
        """Nothing is run in this process, so that no thread of an accelerator's library
        is there to be forked.
        """
        for name, files in FILES.items():
            if name in self.files:
                items = [item for item in session.items if item.path.name in files]
                items.sort(
                    key=lambda item: (SLOW in item.name, files.index(item.path.name))
                )
                self.found[name] = self.count(name, items)
        return True

    def count(self, name, items):
        """Of one file: how many there are and how many survive, and those by name."""
        source = (SOURCES / f"{name}.py").read_text("utf-8")
        if os.waitpid(notices(items, name, source), 0)[1]:
            raise SystemExit(f"the tests of {name} fail on the file as it is")
        waiting, running, survivors = (
            [row for row in mutants_of(name) if self.only in row[0]],
            {},
            [],
        )
        total = len(waiting)
        waiting.reverse()
        while waiting or running:
            while waiting and len(running) < self.jobs:
                what, mutant = waiting.pop()
                running[notices(items, name, mutant)] = what
            child, status = os.wait()
            what = running.pop(child)
            if status == 0:
                survivors.append(what)
                print(f"{name} survives: {what}", flush=True)
        counts = {
            "total": total,
            "killed": total - len(survivors),
            "named": len(NAMED[name]),
            "survived": {},
        }
        for what in sorted(survivors):
            reasons = [
                reason
                for reason, texts in ARGUED.items()
                if any(text in what for text in texts)
            ]
            counts["survived"][what] = reasons[0] if reasons else UNARGUED
        return counts | {"sha256": hashlib.sha256(source.encode()).hexdigest()}


def main():
    """Count and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", nargs="+", choices=FILES, default=list(FILES))
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument(
        "--only", default="", help="of those whose description holds this"
    )
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    began, plugin = time.perf_counter(), Mutate(asked.jobs, asked.files, asked.only)
    tests = sorted({str(TESTS / test) for name in asked.files for test in FILES[name]})
    # Without the types that other test runs check: a mutant must be noticed by what it
    # computes.
    status = pytest.main(
        [
            "-q",
            "-p",
            "no:cacheprovider",
            "-o",
            "addopts=",
            "--rootdir",
            str(ROOT),
            *tests,
        ],
        [plugin],
    )
    if status or set(plugin.found) != set(asked.files):
        sys.exit(f"pytest ended with {status}")
    counts = {
        name: {key: row[key] for key in ("total", "killed")}
        for name, row in plugin.found.items()
    }
    print(json.dumps({**counts, "seconds": round(time.perf_counter() - began)}))
    reasons = Counter(
        reason for row in plugin.found.values() for reason in row["survived"].values()
    )
    print(json.dumps(reasons, indent=1))
    if asked.out:
        known = artefacts.read_json(asked.out)["files"] if asked.out.exists() else {}
        rows = {
            name: (known | plugin.found)[name]
            for name in FILES
            if name in known | plugin.found
        }
        artefacts.write_json(
            asked.out, {"files": rows, "versions": artefacts.versions()}
        )
    sys.exit(1 if reasons[UNARGUED] else 0)


if __name__ == "__main__":
    main()
