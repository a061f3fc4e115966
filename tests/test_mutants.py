"""Every function of `tests.mutants` has mutants, and its test is there; `python -m tests.mutants` has them found."""

import ast
import re
from pathlib import Path

import pytest

from tests.mutants import ROOT, Mutant, listed, mutants, mutants_of, planted

CODE = '''
def limit(x, y, low):
    """A limit."""
    return -far(x, y) + 2.0 * x.clamp(min=low) if x < low else 0.0
'''


def test_signs_bounds_clamps_numbers_and_names_are_changed() -> None:
    found = [(each.old, each.new) for each in mutants_of("code.py", "limit", "test_code.py", CODE)]
    assert found == [
        ("-", ""),
        ("x, y", "y, x"),
        ("+", "-"),
        ("2.0", "2.2"),
        (".clamp(min=low)", ""),
        ("<", "<="),
    ]


def test_every_listed_function_has_mutants_that_are_python() -> None:
    every = mutants()
    assert {(each.path, each.function) for each in every} == {
        (path, name) for path, names, _ in listed() for name in names
    }
    for mutant in mutants(each=2):
        code = (ROOT / mutant.path).read_bytes()
        assert code[mutant.begin : mutant.end].decode() == mutant.old != mutant.new
        ast.parse(code[: mutant.begin] + mutant.new.encode() + code[mutant.end :])


def test_every_test_that_has_to_find_one_is_there() -> None:
    for _, _, test in listed():
        file, _, chosen = test.partition(" -k ")
        names = re.findall(r"def (test_\w+)", (ROOT / "tests" / file).read_text(encoding="utf-8"))
        for word in re.split(r"\W+", chosen):
            assert word == "or" or any(word in name for name in names), f"{test}: has no {word}"


def test_a_mutant_is_there_while_it_is_tried_and_no_longer(tmp_path: Path) -> None:
    path = tmp_path / "code.py"
    path.write_text("a - b\n")
    with (
        pytest.raises(ZeroDivisionError),
        planted(Mutant("code.py", "f", 2, 3, "-", "+", "test_code.py"), tmp_path),
    ):
        assert path.read_text() == "a + b\n"
        raise ZeroDivisionError
    assert path.read_text() == "a - b\n"
