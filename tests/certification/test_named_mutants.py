"""The named mutants of `benchmarks/robustness/named_mutants.py` fit the source."""

import ast
from pathlib import Path

import pytest

from benchmarks.robustness.named_mutants import ARGUED, FILES, NAMED
from sfkd_jax import certification


def test_every_mutated_file_has_tests_and_named_mutants():
    assert FILES.keys() == NAMED.keys()
    tests = {name for names in FILES.values() for name in names}
    assert [
        name for name in tests if not Path(__file__).with_name(name).is_file()
    ] == []


@pytest.mark.parametrize("name", NAMED)
def test_every_named_mutant_changes_one_place_and_remains_a_program(name):
    source = Path(certification.__file__).with_name(f"{name}.py").read_text("utf-8")
    original = ast.dump(ast.parse(source))
    for text, replacement in NAMED[name]:
        assert source.count(text) == 1, text
        mutant = source.replace(text, replacement)
        assert ast.dump(ast.parse(mutant)) != original, text


def test_every_argument_for_a_survivor_has_texts():
    assert all(texts and all(texts) for texts in ARGUED.values())
