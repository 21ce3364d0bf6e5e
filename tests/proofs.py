"""Documents of the checker in C: taken apart, spoilt, and what it says of them."""

import inspect
import shutil
import struct
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from networks import TURNED

from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import CertificationRefused
from sfkd_jax.certification import rows as tuples
from sfkd_jax.certification._metric_claims import require_output_metric
from sfkd_jax.certification._weights import one_thread
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.export import _proof
from sfkd_jax.types import Polytope

SOURCE = Path(_proof.__file__).with_name(_proof.CHECKER)
COMPILER = next(filter(shutil.which, ("cc", "gcc", "clang")), None)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
require = inspect.unwrap(require_output_metric)
"""Past the types, which test runs check."""


def compiled(folder, *options):
    """The checker as a program; the test is skipped where options are not known."""
    program = folder / f"check_proof{len(options)}"
    command = [COMPILER, *STRICT, *options, "-o", program, SOURCE]
    done = subprocess.run(command, capture_output=True, text=True)
    if options and done.returncode:
        pytest.skip(f"the C compiler does not know {' '.join(options)}")
    assert done.returncode == 0, done.stderr
    return program


def verdicts(program, documents, folder):
    """What the checker prints of each document, in one process."""
    names = [str(folder / f"{number}.bin") for number in range(len(documents))]
    for name, document in zip(names, documents, strict=True):
        Path(name).write_bytes(document)
    done = subprocess.run(
        [program, *names], capture_output=True, text=True, timeout=300
    )
    assert done.stderr == ""
    lines = {name: [] for name in names}
    for line in done.stdout.splitlines():
        name, text = line.split(": ", 1)
        lines[name].append(text)
    accepted = [not found[0].startswith("refused: ") for found in lines.values()]
    assert done.returncode == (0 if all(accepted) else 1)
    assert all(len(found) == 1 for found in lines.values() if "refused" in found[0])
    return accepted, [*lines.values()]


class Reader:
    """Takes a document apart, as its format is described, and by nothing of the writer."""

    def __init__(self, document):
        self.rest = document

    def take(self, size):
        if size > len(self.rest):
            raise EOFError
        taken, self.rest = self.rest[:size], self.rest[size:]
        return taken

    def integers(self, count):
        return struct.unpack(f"<{count}I", self.take(4 * count))

    def array(self, *shape):
        content = self.take(8 * int(np.prod(shape, dtype=object)))
        return np.frombuffer(content, "<f8").reshape(shape)


def read(document):
    """Explicit weights, a frame, and claims by output; EOFError if the sizes lie."""
    reader = Reader(document)
    if reader.take(8) != b"SFKDPRF\0" or reader.integers(1) != (1,):
        raise EOFError
    rank, vertices, layers, outputs = reader.integers(4)
    if not rank or not vertices or not outputs or layers > len(document):
        raise EOFError
    hidden = reader.integers(max(layers - 1, 0))
    if not all(hidden):
        raise EOFError
    reader.take(32)
    operators = reader.array(vertices, rank, rank)
    widths = [rank, *hidden, rank]
    residual = tuple(reader.array(widths[k + 1], widths[k]) for k in range(layers))
    claims, rows = [], []
    for _ in range(outputs):
        letters, count = reader.integers(2)
        reader.take(letters)
        if not count:
            raise EOFError
        alpha, lipschitz = map(float, reader.array(2))
        metric = reader.array(rank, rank)
        rows.append(reader.array(count, rank))
        joint = [[reader.array(width) for width in hidden] for _ in range(vertices)]
        claims.append(
            OutputMetric(
                alpha=alpha,
                lipschitz=lipschitz,
                metric=tuples(metric),
                joint=tuples(joint),
            )
        )
    if reader.rest:
        raise EOFError
    ends = np.cumsum([3, *map(len, rows)])
    entries = {
        f"output {k}": slice(int(ends[k]), int(ends[k + 1])) for k in range(outputs)
    }
    frame = replace(PATH_FRAME, outputs=entries, units=dict.fromkeys(entries, "m"))
    weights = TURNED._replace(
        operators=Polytope(operators), residual=residual, readout=np.concatenate(rows)
    )
    return weights, frame, dict(zip(entries, claims, strict=True))


def accepted_by_core(document):
    """Whether the checks of a certificate accept the numbers of a document."""
    try:
        weights, frame, claims = read(document)
        with one_thread(), np.errstate(all="ignore"):
            for name, claim in claims.items():
                require(name, claim, weights, frame)
    except (EOFError, CertificationRefused):
        return False
    return True


class Layout:
    """Where the parts of a document are, each with how many numbers it has."""

    def __init__(self, document):
        weights, _, claims = read(document)
        rank = weights.readout.shape[1]
        hidden = [len(layer) for layer in weights.residual[:-1]]
        vertices = len(weights.operators.vertices)
        self.begin = 28 + 4 * len(hidden) + 32
        sizes = [vertices * rank**2, *map(np.size, weights.residual)]
        self.parts = {}
        at = self.begin
        for name, size in zip(["vertices", *map(str, range(9))], sizes, strict=False):
            self.parts[name] = (at, size)
            at += 8 * size
        for number in range(len(claims)):
            letters, rows = struct.unpack_from("<2I", document, at)
            at += 8 + letters
            inner = {
                "alpha": 1,
                "lipschitz": 1,
                "metric": rank**2,
                "rows": rows * rank,
                "joint": vertices * sum(hidden),
            }
            for name, size in inner.items():
                self.parts[f"{name} {number}"] = (at, size)
                at += 8 * size
        assert at == len(document)
        self.rank = rank

    def change(self, document, part, change, entry=slice(None)):
        """The document with some numbers of a part replaced by a function of them."""
        at, size = self.parts[part]
        numbers = np.frombuffer(document, "<f8", size, at).copy()
        with np.errstate(all="ignore"):
            numbers[entry] = change(numbers[entry])
        return document[:at] + numbers.tobytes() + document[at + 8 * size :]


layout_of = cache(Layout)
SPECIAL = (np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, 1e-310, 1e-160, 1e160, 1e308)
SCALES = (1e-300, 1e-160, 1e-100, 1e-8, 1 - 1e-9, 1 + 1e-9, 1.001, 1e8, 1e100, 1e160)
CONSTANTS = ("alpha", "lipschitz")


def mutated(document, random):
    """A document that lies somewhere, often by very little."""
    layout = layout_of(document)
    parts = [name for name, (_, size) in layout.parts.items() if size]
    part = parts[random.integers(len(parts))]
    size = layout.parts[part][1]
    one = random.integers(size)
    output = random.integers(2)
    kind = random.integers(12)
    if kind == 0:
        value = SPECIAL[random.integers(len(SPECIAL))]
        return layout.change(document, part, lambda x: value, one)
    if kind == 1:
        error = 10.0 ** -random.uniform(0.0, 17.0) * random.choice([-1.0, 1.0])
        return layout.change(document, part, lambda x: x * (1.0 + error), one)
    if kind == 2:
        return layout.change(document, part, lambda x: -x, one)
    if kind == 3:
        scale = SCALES[random.integers(len(SCALES))]
        return layout.change(document, part, lambda x: scale * x)
    if kind in (4, 5):
        name = f"{CONSTANTS[kind - 4]} {output}"
        share = 1.0 + 10.0 ** -random.uniform(1.0, 12.0) * random.choice([-1.0, 1.0])
        return layout.change(document, name, lambda x: share * x)
    if kind == 6:
        matrices = layout.parts["vertices"][1] // layout.rank**2
        first = layout.rank**2 * random.integers(matrices)
        vertex = slice(first, first + layout.rank**2)
        return layout.change(document, "vertices", lambda x: 1.001 * x, vertex)
    if kind == 7:
        # P stays symmetric, or of size 1, or neither.
        row, column = random.integers(layout.rank, size=2)
        error = 10.0 ** -random.uniform(1.0, 17.0)
        both = [row * layout.rank + column, column * layout.rank + row]
        entries = both[: random.integers(1, 3)]
        return layout.change(document, f"metric {output}", lambda x: x + error, entries)
    if kind == 8:
        # The same claim in another unit of the output.
        scale = 2.0 ** random.integers(-400, 400)
        other = layout.change(document, f"rows {output}", lambda x: scale * x)
        return layout.change(other, f"lipschitz {output}", lambda x: scale * x)
    if kind == 9:
        changed = bytearray(document)
        at = 8 + 4 * random.integers((layout.begin - 40) // 4)
        value = struct.unpack_from("<I", document, at)[0]
        others = [value + 1, max(value, 1) - 1, 0, 2**31, 2**32 - 1, 2 * value]
        struct.pack_into(
            "<I", changed, at, others[random.integers(len(others))] % 2**32
        )
        return bytes(changed)
    if kind == 10:
        length = random.integers(len(document))
        longer = document + random.bytes(random.integers(1, 20))
        return longer if random.integers(2) else document[:length]
    changed = bytearray(document)
    at = random.integers(layout.begin, len(document))
    changed[at] ^= 1 << random.integers(8)
    return bytes(changed)


def disagreements(program, original, count, seed, folder):
    """Mutated documents on which the checker and the core differ, and how many hold."""
    random = np.random.default_rng(seed)
    documents = [mutated(original, random) for _ in range(count)]
    expected = [accepted_by_core(changed) for changed in documents]
    accepted, lines = verdicts(program, documents, folder)
    differ = [
        (number, ours, lines[number][0])
        for number, (ours, theirs) in enumerate(zip(expected, accepted, strict=True))
        if ours != theirs
    ]
    return differ, sum(expected)
