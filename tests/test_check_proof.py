"""The checker in C gives the verdict of the trusted core, whatever the document says."""

import inspect
import re
import shutil
import struct
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from networks import JOINT, METRIC, NOTHING, TURNED, TURNED_METRICS

import sfkd_jax
from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import CertificationRefused, readouts
from sfkd_jax.certification import rows as tuples
from sfkd_jax.certification._metric_claims import require_output_metric
from sfkd_jax.certification._metrics import accepted_metric
from sfkd_jax.certification._weights import one_thread
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.export import _proof
from sfkd_jax.types import Polytope

SOURCE = Path(_proof.__file__).with_name(_proof.CHECKER)
COMPILER = next(filter(shutil.which, ("cc", "gcc", "clang")), None)
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
HOSTILE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
require = inspect.unwrap(require_output_metric)
"""Past the types, which test runs check."""
WEIGHTS_SHA256 = "0123456789abcdef" * 4


def compiled(folder, *options):
    """The checker as a program; the test is skipped where options are not known."""
    program = folder / f"check_proof{len(options)}"
    command = [COMPILER, *STRICT, *options, "-o", program, SOURCE]
    done = subprocess.run(command, capture_output=True, text=True)
    if options and done.returncode:
        pytest.skip(f"the C compiler does not know {' '.join(options)}")
    assert done.returncode == 0, done.stderr
    return program


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("checker"))


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


def document(weights=TURNED, outputs=TURNED_METRICS):
    rows = readouts(weights, PATH_FRAME)
    return _proof.proof_bytes(weights, rows, outputs, WEIGHTS_SHA256)


@cache
def shipped(name):
    return _proof.exported_proof(sfkd_jax.load(name))


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


@needs_compiler
@pytest.mark.parametrize("name", ["kinematic_path", "dynamic_path"])
def test_the_proof_of_a_policy_that_ships_is_accepted(name, program, tmp_path):
    policy = sfkd_jax.load(name)
    (accepted,), (lines,) = verdicts(program, [shipped(name)], tmp_path)
    assert accepted
    assert lines[0] == f"proved about the weights {policy.weights_sha256}"
    printed = [re.fullmatch(r"(.*): alpha (.*), L (.*)", line) for line in lines[1:]]
    claims = policy.certificate.proof.outputs
    assert {line[1]: (float(line[2]), float(line[3])) for line in printed} == {
        output: (claim.alpha, claim.lipschitz) for output, claim in claims.items()
    }


def test_a_policy_whose_outputs_have_no_metric_has_no_proof_to_check():
    assert _proof.exported_proof(sfkd_jax.load("kinematic")) is None


def other_networks():
    """Documents without residual, with a linear one, and an output of several rows."""
    bare = TURNED._replace(**NOTHING)
    linear = TURNED._replace(residual=(0.1 * METRIC,), residual_multipliers=())
    for weights in (bare, linear):
        joint = [[] for _ in weights.operators.vertices]
        rows = readouts(weights, PATH_FRAME)["position"]
        claim = accepted_metric(weights, rows, METRIC, joint)
        yield document(weights, {"position": claim})
    several = accepted_metric(TURNED, TURNED.readout, METRIC, JOINT)
    rows = {"all \N{GREEK SMALL LETTER XI}\r\x1b[2J": TURNED.readout}
    named = dict.fromkeys(rows, several)
    yield _proof.proof_bytes(TURNED, rows, named, WEIGHTS_SHA256)


@needs_compiler
def test_networks_of_any_depth_are_checked_and_names_are_printed_safely(
    program, tmp_path
):
    documents = [*other_networks()]
    assert [*map(accepted_by_core, documents)] == [True] * 3
    accepted, lines = verdicts(program, documents, tmp_path)
    assert accepted == [True] * 3
    assert lines[2][1].startswith("all \N{GREEK SMALL LETTER XI}??[2J: alpha 0.")
    lower = [
        layout_of(one).change(one, "alpha 0", lambda x: 0.99 * x) for one in documents
    ]
    assert [*map(accepted_by_core, lower)] == [False] * 3
    assert verdicts(program, lower, tmp_path)[0] == [False] * 3


@needs_compiler
@pytest.mark.parametrize(
    ("part", "change", "reason"),
    [
        ("alpha 0", lambda x: 0.999 * x, "alpha does not follow from its witness"),
        ("alpha 1", lambda x: 1.0 + 0.0 * x, "alpha is not between 0 and 1"),
        ("lipschitz 1", lambda x: 0.999 * x, "L does not follow from P"),
        ("joint 0", lambda x: -x, "alpha does not follow from its witness"),
        ("metric 0", lambda x: x + np.eye(3).ravel()[::-1] / 2, "P is not of size 1"),
        ("metric 1", lambda x: 1.001 * x, "P is not of size 1"),
        ("metric 1", lambda x: x + 1e-3 * np.eye(1, 9, 1)[0], "P is not symmetric"),
    ],
)
def test_a_refusal_is_one_line_with_the_claim_and_its_output(
    part, change, reason, program, tmp_path
):
    original = document()
    changed = layout_of(original).change(original, part, change)
    assert not accepted_by_core(changed)
    _, ((line,),) = verdicts(program, [changed], tmp_path)
    assert line == f"refused: {reason}, output: {[*TURNED_METRICS][int(part[-1])]}"


@needs_compiler
def test_it_refuses_just_below_the_limit_of_the_core_and_accepts_just_above(
    program, tmp_path
):
    """A few parts in 10^9: rounding is bounded, and by not much more than it is."""
    original = document()
    layout = layout_of(original)
    near = []
    for part in ("alpha 0", "alpha 1", "lipschitz 0", "lipschitz 1"):
        low, high = 0.9, 1.0
        while high - low > 1e-12:
            middle = 0.5 * (low + high)
            changed = layout.change(original, part, lambda x, share=middle: share * x)
            low, high = (low, middle) if accepted_by_core(changed) else (middle, high)
        near += [
            layout.change(original, part, lambda x, share=share: share * x)
            for share in (low * (1.0 - 1e-9), high * (1.0 + 1e-9))
        ]
    assert verdicts(program, near, tmp_path)[0] == [False, True] * 4


@needs_compiler
def test_hundreds_of_documents_that_lie_get_the_verdict_of_the_core(program, tmp_path):
    """10 000 were compared once, see the exhaustive test: none differed."""
    differ, count = disagreements(program, document(), 400, 0, tmp_path)
    assert differ == []
    assert 40 < count < 360
    for seed, name in enumerate(("kinematic_path", "dynamic_path")):
        assert disagreements(program, shipped(name), 25, seed, tmp_path)[0] == []


@needs_compiler
@pytest.mark.exhaustive
def test_ten_thousand_documents_that_lie_get_the_verdict_of_the_core(program, tmp_path):
    originals = {
        document(): 4000,
        shipped("kinematic_path"): 3000,
        shipped("dynamic_path"): 3000,
    }
    for number, (original, count) in enumerate(originals.items()):
        for batch in range(count // 500):
            seed = 100 + 10 * batch + number
            differ, _ = disagreements(program, original, 500, seed, tmp_path)
            assert differ == []


@needs_compiler
def test_no_document_makes_it_read_or_write_beyond_its_memory(tmp_path):
    program = compiled(tmp_path, *HOSTILE)
    random = np.random.default_rng(0)
    original = document()
    documents = [mutated(original, random) for _ in range(200)]
    head = original[: layout_of(original).begin]
    documents += [head + random.bytes(random.integers(2000)) for _ in range(50)]
    # Random sizes, of which many fit in no memory.
    documents += [original[:12] + random.bytes(400) for _ in range(50)]
    documents += [b"", original[:8], original[:12], b"\0" * 4000]
    accepted, _ = verdicts(program, documents, tmp_path)
    assert any(accepted)
    assert not any(accepted[200:])


EMBEDDED = """
#define NO_MAIN
#include "check_proof.c"
#include <xmmintrin.h>
static unsigned char flash[100000];
int main(void) {
    size_t length = fread(flash, 1, sizeof flash, stdin);
    int accepted = check_proof("flash", flash, length);
    _mm_setcsr(_mm_getcsr() | FLAGS);
    return !accepted + 2 * check_proof("flash", flash, length);
}
"""
"""Checks a proof in memory, again after the processor was told to compute otherwise."""


@needs_compiler
@pytest.mark.parametrize(
    "flags",
    ["0x8000", "0x0040", "0x2000", "0x4000", "0x6000"],
    ids=["FTZ", "DAZ", "-", "+", "0"],
)
def test_a_processor_that_flushes_or_does_not_round_proves_nothing(flags, tmp_path):
    source = tmp_path / "embedded.c"
    source.write_text(EMBEDDED.replace("FLAGS", flags))
    command = [COMPILER, "-std=c99", "-O2", "-I", SOURCE.parent, "-o", tmp_path / "run"]
    done = subprocess.run([*command, source], capture_output=True, text=True)
    if "xmmintrin.h" in done.stderr:
        pytest.skip("this processor sets such flags otherwise")
    assert done.returncode == 0, done.stderr
    checked = subprocess.run([tmp_path / "run"], input=document(), capture_output=True)
    assert checked.returncode == 0
    assert b"this processor flushes" in checked.stdout


@needs_compiler
def test_it_is_not_compiled_without_ieee_arithmetic(tmp_path):
    command = [COMPILER, "-std=c99", "-ffast-math", "-c", "-o", tmp_path / "o", SOURCE]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode != 0
    assert "compile without -ffast-math" in done.stderr


def test_the_source_is_short_and_needs_neither_libm_nor_an_allocator():
    text = SOURCE.read_text("ascii")
    headers = {"float.h", "stdint.h", "stdio.h", "string.h"}
    assert {*re.findall(r"#include [<\"](.*)[>\"]", text)} == headers
    assert len(text.splitlines()) <= 300
