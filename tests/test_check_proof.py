"""The checker in C gives the verdict of the trusted core, whatever the document says."""

import re
import struct
import subprocess
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
from exact import exact_witness, forged_witness, hostile_matrix, is_definite, rational
from networks import JOINT, METRIC, NOTHING, TURNED, TURNED_METRICS
from proofs import (
    COMPILER,
    SOURCE,
    accepted_by_core,
    compiled,
    disagreements,
    layout_of,
    mutated,
    needs_compiler,
    read,
    verdicts,
)

import sfkd_jax
from sfkd_jax.certificate import OutputMetric
from sfkd_jax.certification import is_positive_definite, readouts
from sfkd_jax.certification import rows as tuples
from sfkd_jax.certification._metrics import accepted_metric
from sfkd_jax.driving.path_coordinates import PATH_FRAME
from sfkd_jax.export import _proof
from sfkd_jax.types import Polytope

HOSTILE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
WEIGHTS_SHA256 = "0123456789abcdef" * 4
SMALL = 10.0 ** -np.arange(8.0, 17.0, 0.5)


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return compiled(tmp_path_factory.mktemp("checker"))


def document(weights=TURNED, outputs=TURNED_METRICS):
    rows = readouts(weights, PATH_FRAME)
    return _proof.proof_bytes(weights, rows, outputs, WEIGHTS_SHA256)


@cache
def shipped(name):
    return _proof.exported_proof(sfkd_jax.load(name))


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


def with_share(original, part, share):
    """The document with a constant multiplied by a share."""
    return layout_of(original).change(original, part, lambda x: share * x)


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
    assert lines[2][1].startswith("all ????[2J: alpha 0.")
    lower = [with_share(one, "alpha 0", 0.99) for one in documents]
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


BOUNDS = ("alpha 0", "alpha 1", "lipschitz 0", "lipschitz 1")


def limit(original, part, holds):
    """Two shares of a constant that differ by rounding: it holds with the second alone."""
    low, high = 0.9, 1.0
    for _ in range(50):
        middle = 0.5 * (low + high)
        if holds(with_share(original, part, middle)):
            high = middle
        else:
            low = middle
    return low, high


@needs_compiler
def test_it_refuses_just_below_the_limit_of_the_core_and_accepts_just_above(
    program, tmp_path
):
    """A part in 10^9: its bounds on rounding are other ones."""
    original = document()
    near = []
    for part in BOUNDS:
        low, high = limit(original, part, accepted_by_core)
        near.append(with_share(original, part, low * (1.0 - 1e-9)))
        near.append(with_share(original, part, high * (1.0 + 1e-9)))
    assert verdicts(program, near, tmp_path)[0] == [False, True] * 4


@needs_compiler
def test_hundreds_of_documents_that_lie_get_the_verdict_of_the_core(program, tmp_path):
    """10 000 were compared once, see the exhaustive test: none differed."""
    differ, count = disagreements(program, document(), 400, 0, tmp_path)
    assert differ == []
    assert 40 < count < 360
    for seed, name in enumerate(("kinematic_path", "dynamic_path")):
        assert disagreements(program, shipped(name), 15, seed, tmp_path)[0] == []


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


def embedded(folder, text):
    """A program around the functions of the checker."""
    source = folder / "embedded.c"
    source.write_text(text)
    command = [COMPILER, "-std=c99", "-O2", "-I", SOURCE.parent, "-o", folder / "run"]
    done = subprocess.run([*command, source], capture_output=True, text=True)
    if "xmmintrin.h" in done.stderr:
        pytest.skip("this processor sets its flags otherwise")
    assert done.returncode == 0, done.stderr
    return folder / "run"


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
    program = embedded(tmp_path, EMBEDDED.replace("FLAGS", flags))
    checked = subprocess.run([program], input=document(), capture_output=True)
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


# --- nothing false is accepted, in exact arithmetic ------------------------------------


def follows_exactly(document):
    """Whether every matrix of a document is positive definite, in fractions."""
    weights, frame, claims = read(document)
    rows = readouts(weights, frame)
    for name, claim in claims.items():
        metric = np.asarray(claim.metric)
        squared = rational(rows[name]).T.dot(rational(rows[name]))
        matrices = [Fraction(claim.lipschitz) ** 2 * rational(metric) - squared]
        for vertex, joint in zip(weights.operators.vertices, claim.joint, strict=True):
            multipliers = [np.asarray(part) for part in joint]
            given = (weights.residual, multipliers, claim.alpha, vertex, metric)
            matrices += exact_witness(*given)
        if not all(map(is_definite, matrices)):
            return False
    return True


@needs_compiler
def test_what_it_accepts_follows_in_exact_arithmetic_however_near_the_limit(
    program, tmp_path
):
    original = document()
    near = []
    for part in BOUNDS:
        _, high = limit(original, part, follows_exactly)
        shares = high + np.concatenate([-SMALL, SMALL])
        near += [with_share(original, part, share) for share in shares]
    accepted, _ = verdicts(program, near, tmp_path)
    true = [*map(follows_exactly, near)]
    assert not np.any(np.asarray(accepted) & ~np.asarray(true))
    assert sum(accepted) > 0.5 * sum(true) > 0


DEFINITE = """
#define NO_MAIN
#include "check_proof.c"
int main(void) {
    uint32_t size;
    double error;
    while (fread(&size, sizeof size, 1, stdin) && fread(&error, sizeof error, 1, stdin)) {
        for (uint32_t i = 0; i < size; i++)
            if (fread(matrix[i], sizeof error, size, stdin) != size) return 1;
        putchar(is_positive_definite(size, error) ? '1' : '0');
    }
    return 0;
}
"""
"""Says of matrices from stdin whether they are positive definite."""


@needs_compiler
def test_thousands_of_hostile_matrices_against_exact_arithmetic_and_the_core(tmp_path):
    """200 000 of seed 1 were driven once: none was accepted and not definite."""
    program = embedded(tmp_path, DEFINITE)
    random = np.random.default_rng(0)
    shown = [hostile_matrix(random) for _ in range(3000)]
    given = b"".join(
        struct.pack("=Id", len(matrix), error) + matrix.tobytes()
        for matrix, error in shown
    )
    checked = subprocess.run([program], input=given, capture_output=True, check=True)
    accepted = [digit == ord("1") for digit in checked.stdout]
    for (matrix, error), yes in zip(shown, accepted, strict=True):
        if yes:
            moved = Fraction(error) * rational(np.eye(len(matrix)))
            assert is_definite(rational(matrix) - moved), (matrix, error)
        # The core scales also what is hardly a number any more.
        elif 1e-300 < np.trace(matrix) < 1e300:
            assert not is_positive_definite(matrix, error), (matrix, error)
    assert sum(accepted) > 500


@needs_compiler
def test_a_factorisation_that_meets_a_pivot_that_is_no_number_proves_nothing(
    program, tmp_path
):
    residual, multipliers, alpha = forged_witness()
    rank = residual[0].shape[1]
    weights = TURNED._replace(
        operators=Polytope(np.zeros((1, rank, rank))), residual=tuple(residual)
    )
    claim = OutputMetric(
        alpha=alpha,
        lipschitz=1.1,
        metric=tuples(np.eye(rank)),
        joint=tuples([multipliers]),
    )
    rows = {"first": np.eye(1, rank)}
    forged = _proof.proof_bytes(weights, rows, {"first": claim}, WEIGHTS_SHA256)
    _, ((line,),) = verdicts(program, [forged], tmp_path)
    assert line == "refused: alpha does not follow from its witness, output: first"
