"""Each fault of `tests.faults` can be planted, and its test is there; `python -m tests.mutants` has them found."""

import re
from pathlib import Path

import pytest

from tests.faults import FAULTS, Fault
from tests.mutants import ROOT, planted

PACKAGES = {"experiments", "inspection", "rta", "ppo", "kernels", "interfaces", "study"}


def test_every_fault_can_be_planted_where_it_says() -> None:
    for fault in FAULTS:
        count = (ROOT / fault.path).read_text(encoding="utf-8").count(fault.old)
        assert count == 1, f"{fault}: stands {count} times there"
        assert fault.old != fault.new and "\n" not in fault.old + fault.new, fault


def test_every_test_that_has_to_find_one_is_there() -> None:
    for fault in FAULTS:
        text = (ROOT / fault.test_file).read_text(encoding="utf-8")
        names = re.findall(r"def (test_\w+)", text)
        wanted = [
            word for word in re.split(r"\W+", fault.test.partition(" -k ")[2]) if word not in ("", "or")
        ]
        for word in wanted:
            assert any(word in name for name in names) or word in text, f"{fault.test}: has no {word}"


def test_there_are_faults_in_every_package_and_in_c() -> None:
    assert len({(fault.path, fault.old, fault.new) for fault in FAULTS}) == len(FAULTS) >= 80
    assert {fault.path.partition("/")[0] for fault in FAULTS} == PACKAGES
    of_c = [
        fault for fault in FAULTS if fault.path.startswith(("kernels/", "rta/fast/"))
    ]  # C, and what prints it
    assert len(of_c) >= 36


def test_a_fault_is_there_while_it_is_tried_and_no_longer(tmp_path: Path) -> None:
    path = tmp_path / "code.py"
    path.write_text("a - b\n")
    fault = Fault("code.py", "a - b", "a + b", "test_code.py")
    with pytest.raises(ZeroDivisionError), planted(fault, tmp_path):
        assert path.read_text() == "a + b\n"
        raise ZeroDivisionError
    assert path.read_text() == "a - b\n"
    with pytest.raises(ValueError, match="stands 0 times"), planted(fault._replace(old="b - a"), tmp_path):
        pass
