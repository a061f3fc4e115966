"""The exported filter in C: warnings, answers, sanitizers, MISRA, stack, other architectures, its own test.

Where controls are held compilers take half a minute for a filter, so that most of those tests are campaigns.
"""

import functools
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from kernels.build import OF_ONE, OF_TWO, QUICK
from rta.fast import files, vectors
from rta.fast.files import BUILT, NOT_VERIFIED, VERSION, sources, write
from rta.fast.filter import fast
from rta.filter import SafetyFilter
from rta.names import CONSTRAINTS
from rta.result import Status
from tests.rta import test_own as own
from tests.rta.fast.export_sizes import GRAPH, deepest
from tests.rta.fast.export_states import PROGRAM, Answers, in_c, in_python, made, states

STRICT = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror")
STRICTER = ("-Wshadow", "-Wstrict-prototypes", "-Wmissing-prototypes", "-Wcast-qual", "-Wundef", "-Wvla")
# Not optimised: the compiler then takes a sixth of the time, and removes nothing before it can be looked at.
SANITIZED = ("-std=c99", "-O0", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
CROSS = {
    "aarch64": ("aarch64-linux-gnu-gcc", "qemu-aarch64", "/usr/aarch64-linux-gnu"),
    "arm": ("arm-linux-gnueabihf-gcc", "qemu-arm", "/usr/arm-linux-gnueabihf"),
}
PARTS = ("safety_filter.h", "safety_filter.c", "example.c")
LARGEST_STACK = 64_000  # B, of all calls together
# Of MISRA C:2012 as cppcheck knows it; docs/guides/export.md says why each stands.
DEVIATIONS = ("2.4", "2.5", "5.6", "8.7", "8.9", "9.3", "10.3", "10.6", "12.1", "14.1")


def campaign(*values: Any) -> Any:
    """Returns a parameter of tests that take minutes."""
    return pytest.param(*values, marks=pytest.mark.campaign)


class Made(NamedTuple):
    """Holds a filter and the directory it was written into."""

    safety_filter: SafetyFilter
    directory: Path


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Made]:
    """Returns each filter, written once, only for reading; without `whole` header, source and example alone."""

    @functools.cache
    def export(kind: str, whole: bool = False) -> Made:
        safety_filter = made("1", extra=own.EXTRA) if kind == "own" else made(kind)
        directory = tmp_path_factory.mktemp("export") / "c"
        if whole:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(vectors, "batched", fast)  # in PyTorch they take a quarter of a minute
                write(safety_filter, directory)
        else:
            directory.mkdir()
            for name, text in sources(safety_filter, only=PARTS).items():
                (directory / name).write_text(text)
        return Made(safety_filter, directory)

    return export


@pytest.fixture(scope="module")
def drawn() -> tuple[Tensor, Tensor]:
    return states(2000, seed=5)


@pytest.fixture(params=["gcc", "clang"])
def compiler(request: pytest.FixtureRequest) -> str:
    return tool(request.param)


def tool(name: str) -> str:
    if not shutil.which(name):
        pytest.skip(f"there is no {name} here")
    return name


def run(*words: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, timeout=300, **options)


def succeed(*words: str | Path, **options: Any) -> str:
    done = run(*words, **options)
    assert done.returncode == 0, (done.stdout + done.stderr)[:3000]
    return done.stdout


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Returns PROGRAM with the filter in a directory, by a command; each once, since optimising takes seconds."""

    @functools.cache
    def build(directory: Path, *command: str) -> Path:
        folder = tmp_path_factory.mktemp("program")
        (folder / "program.c").write_text(PROGRAM)
        own = ["-I", directory, "-c", directory / "safety_filter.c", "-o", folder / "filter.o"]
        succeed(*command, *own, cwd=folder)
        parts = folder / "program.c", folder / "filter.o"
        succeed(*command, "-I", directory, "-o", folder / "program", *parts, "-lm")
        return folder / "program"

    return build


@functools.cache
def optimised() -> tuple[str, ...]:
    """Returns the gcc command that builds a filter, with GRAPH if gcc knows it."""
    gcc = tool("gcc")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "nothing.c").write_text("extern int nothing;\n")
        knows = run(gcc, *STRICT, *GRAPH, "-c", "nothing.c", cwd=folder).returncode == 0
    return (gcc, *STRICT, *(GRAPH if knows else ()))


def assert_same(safety_filter: SafetyFilter, x: Tensor, expected: Answers, found: Answers) -> None:
    """Statuses and checks are equal, controls and values to 1e-9, of unsolved calls, too."""
    limit = torch.tensor(safety_filter.c.control_limit, dtype=torch.float64)[:, None]
    assert torch.equal(found.status, expected.status) and torch.equal(found.check, expected.check)
    assert ((found.control - expected.control).abs() <= 1e-9 * limit).all()
    off = (found.h - expected.h).abs() / expected.h.abs().clamp(min=1.0)
    assert (off[:, x.isfinite().all(0)] <= 1e-9).all()
    assert (found.control.abs() <= limit).all()


@pytest.mark.campaign
@pytest.mark.parametrize(("kind", "count"), [("1", 4000), *((kind, 400) for kind in ("5", "10", "u1"))])
def test_c_answers_as_pytorch(
    kind: str, count: int, exported: Callable[..., Made], program: Callable[..., Path]
) -> None:
    """Back to back with PyTorch's batches; `test_in_c` has fewer states."""
    safety_filter, directory = exported(kind)
    x, desired = states(count, seed=5)
    expected = in_python(safety_filter, x, desired)
    assert all((expected.status == each).sum() > 5 for each in list(Status)[1:])
    assert_same(safety_filter, x, expected, in_c([program(directory, *optimised())], x, desired))


@pytest.mark.parametrize("kind", ["1", campaign("own"), campaign("u1_thrust_quantum"), campaign("10")])
def test_no_compiler_has_anything_to_say(kind: str, compiler: str, exported: Callable[..., Made]) -> None:
    directory = exported(kind).directory
    succeed(compiler, *STRICT, *STRICTER, "-fsyntax-only", directory / "safety_filter.c")
    succeed(compiler, *STRICT, *STRICTER, "-fsyntax-only", directory / "example.c")


@pytest.mark.parametrize(
    ("kind", "optimised"),
    [("1", False), campaign("1", True), *(campaign(kind, False) for kind in ("own", "u1", "10"))],
)
def test_its_own_test_and_its_example_pass(
    kind: str,
    optimised: bool,
    exported: Callable[..., Made],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    directory = shutil.copytree(exported(kind, whole=True).directory, tmp_path / "c")
    flags = [] if optimised else ["CFLAGS=-std=c99 -O0 -ffp-contract=off -Werror"]
    said = succeed(tool("make"), "-C", directory, *flags, "test", "run")
    assert re.search(r"passed: 1[0-4]\d calls, 0 with another status", said) and "NOT VERIFIED" not in said
    assert re.search(r"calls: 0 as desired, \d+ corrected, \d+ with slack, 0 unsolved; 0 violations", said)
    assert set(BUILT) <= {path.name for path in directory.iterdir()}
    monkeypatch.setattr(files, "vectors_header", lambda safety_filter: "")
    write(exported(kind, whole=True).safety_filter, directory)  # over what was built


FLAWS = {
    "a weight": ("ALL(1000000.0)", "ALL(1.0)"),
    "a sign": ("(((a) < (b)) || ((a) != (a)))", "(((a) > (b)) || ((a) != (a)))"),
    "the stages": ("k < 2 && ", "k < 1 && "),
    "what is no number": ("ALL(NAN)", "ALL(0.0)"),
    "the limits": ("#define MIN_LITERAL(a, b) (((b) < (a)) ? (b) : (a))", "#define MIN_LITERAL(a, b) (a)"),
}


@pytest.mark.parametrize(
    "flaw",
    ["the limits", *(campaign(flaw) for flaw in ("a weight", "a sign", "the stages", "what is no number"))],
)
def test_its_own_test_fails_with_a_flaw(flaw: str, exported: Callable[..., Made], tmp_path: Path) -> None:
    directory = shutil.copytree(exported("1", whole=True).directory, tmp_path / "c")
    source = directory / "safety_filter.c"
    before, after = FLAWS[flaw]
    assert before in source.read_text()
    source.write_text(source.read_text().replace(before, after))
    done = run(tool("make"), "-C", directory, "CFLAGS=-std=c99 -O0", "test")
    assert done.returncode == 2 and "FAILED" in done.stdout
    assert not shutil.which("sha256sum") or "NOT VERIFIED: safety_filter.c or .h was changed" in done.stdout


@pytest.mark.parametrize("kind", [campaign(kind) for kind in ("1", "10", "u1")])
def test_sanitizers_find_nothing(
    kind: str,
    compiler: str,
    exported: Callable[..., Made],
    drawn: tuple[Tensor, Tensor],
    program: Callable[..., Path],
    tmp_path: Path,
) -> None:
    (tmp_path / "nothing.c").write_text("int main(void) { return 0; }\n")
    if run(compiler, *SANITIZED, tmp_path / "nothing.c", "-o", tmp_path / "nothing").returncode:
        pytest.skip(f"{compiler} has no sanitizers here")
    x, desired = drawn
    in_c([program(exported(kind).directory, compiler, *SANITIZED)], x, desired)


@pytest.mark.parametrize("kind", [campaign(kind) for kind in ("1", "10", "u1")])
@pytest.mark.parametrize("machine", CROSS)
def test_another_architecture_answers_the_same(
    kind: str,
    machine: str,
    exported: Callable[..., Made],
    drawn: tuple[Tensor, Tensor],
    program: Callable[..., Path],
) -> None:
    gcc, emulator, libraries = CROSS[machine]
    tool(gcc), tool(emulator)
    x, desired = drawn
    safety_filter, directory = exported(kind)
    here = in_c([program(directory, *optimised())], x, desired)
    there = program(directory, gcc, *STRICT, "-ffp-contract=off")
    assert_same(safety_filter, x, here, in_c([emulator, "-L", libraries, there], x, desired))


def test_it_keeps_nothing_and_calls_nothing_but_the_mathematics(
    compiler: str, exported: Callable[..., Made], program: Callable[..., Path]
) -> None:
    command = optimised() if compiler == "gcc" else (compiler, *STRICT)
    built = program(exported("1").directory, *command).with_name("filter.o")
    symbols = [line.split()[-2:] for line in succeed(tool("nm"), built).splitlines()]
    needed = {name for symbol, name in symbols if symbol == "U"}
    allowed = {"memcpy", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}  # a compiler's own
    assert needed - allowed <= {*QUICK, *OF_ONE, *OF_TWO, "fabs", "fmin", "fmax", "sincos"}
    assert {name for symbol, name in symbols if symbol in "TDRB"} == {"safety_filter", "safety_filter_names"}
    assert {symbol for symbol, _ in symbols} <= set("UTtrRdD")
    assert not {name for symbol, name in symbols if symbol in "dDbB"} - {"safety_filter_names"}


@pytest.mark.parametrize("flag", ["-ffast-math", "-ffinite-math-only"])
def test_it_refuses_flags_that_take_nan_away(
    flag: str, compiler: str, exported: Callable[..., Made], tmp_path: Path
) -> None:
    source = exported("1").directory / "safety_filter.c"
    done = run(compiler, "-std=c99", flag, "-fsyntax-only", source)
    assert done.returncode and "compile it without -ffast-math" in done.stderr


@pytest.mark.campaign
def test_filters_of_two_prefixes_fit_into_one_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vectors, "batched", fast)  # see `exported`
    gcc, safety_filter = tool("gcc"), made("1")
    for prefix in ("near", "far_away"):
        texts = write(safety_filter, tmp_path / prefix, prefix=prefix)
        assert f"test_{prefix}.c" in texts and not any(
            "safety_filter" in text.lower() for text in texts.values()
        )
        succeed(
            gcc, "-std=c99", "-O0", "-c", tmp_path / prefix / f"{prefix}.c", "-o", tmp_path / f"{prefix}.o"
        )
        symbols = [line.split()[-2:] for line in succeed(tool("nm"), tmp_path / f"{prefix}.o").splitlines()]
        assert {name for kind, name in symbols if kind in "TDRB"} == {prefix, f"{prefix}_names"}
    (tmp_path / "both.c").write_text(
        """#include "near/near.h"
#include "far_away/far_away.h"

int main(void)
{
    struct near_input in = {.state = {60.0, [9] = 1.0, [13] = 5.0, [14] = 6.0}};
    struct near_output out;
    struct far_away_output other;
    near(&in, &out);
    far_away(&(struct far_away_input){.state = {60.0, [9] = 1.0, [13] = 5.0, [14] = 6.0}}, &other);
    return (out.status == NEAR_UNSOLVED) || (other.status == FAR_AWAY_UNSOLVED);
}
"""
    )
    parts = tmp_path / "both.c", tmp_path / "near.o", tmp_path / "far_away.o"
    succeed(gcc, "-std=c99", "-o", tmp_path / "both", *parts, "-lm")
    succeed(tmp_path / "both")
    done = run(tool("make"), "-C", tmp_path / "far_away", "CFLAGS=-std=c99 -O0", "test")
    assert done.returncode == 0 and "passed" in done.stdout and "NOT VERIFIED: far_away" not in done.stdout
    write(safety_filter, tmp_path / "near", prefix="near")  # an older one of its own
    with pytest.raises(ValueError, match=r"holds no filter but .*near"):
        write(safety_filter, tmp_path / "near", prefix="far_away")


@pytest.mark.parametrize(
    ("prefix", "words"),
    [
        *((prefix, "lower-case letters, digits and _") for prefix in ("", "3u", "Near", "a-b", "é", "int")),
        ("step", "name of something else"),
    ],
)
def test_a_prefix_that_is_no_name_of_its_own_is_refused(prefix: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=words):
        write(made("1"), tmp_path / "c", prefix=prefix)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("kind", "most"), [("1", 16_000), campaign("u1", LARGEST_STACK), campaign("10", LARGEST_STACK)]
)
def test_the_stack_is_bounded_and_nothing_recurses(
    kind: str, most: int, exported: Callable[..., Made], program: Callable[..., Path]
) -> None:
    if not set(GRAPH) <= set(optimised()):
        pytest.skip("this gcc knows no call graphs")
    built = program(exported(kind).directory, *optimised())
    assert 1000 < deepest((built.parent / "filter.ci").read_text()) <= most


@pytest.mark.parametrize("kind", ["1", campaign("u1_thrust_quantum")])
def test_it_keeps_misras_rules(kind: str, exported: Callable[..., Made], tmp_path: Path) -> None:
    """But for DEVIATIONS. Printed functions take cppcheck hours: the model, printed likewise, stands for them."""
    if run(tool("cppcheck"), "--addon=misra", os.devnull).returncode:
        pytest.skip("cppcheck has no rules of MISRA here")
    directory = exported(kind).directory
    shutil.copy(directory / "safety_filter.h", tmp_path)
    text, example = ((directory / name).read_text() for name in ("safety_filter.c", "example.c"))
    head = '#include <math.h>\n#include "safety_filter.h"\ntypedef double V;\ntypedef int M;\n'
    order = text[text.index("static void filter(") :]
    prototype = order[: order.index("\n{")] + ";\n"
    (tmp_path / "call.c").write_text(head + prototype + text[text.index("#define TOLD") :])
    (tmp_path / "model.c").write_text(
        "#include <math.h>\n" + example[example.index("typedef double real;") :]
    )
    rules = [f"--suppress=misra-c2012-{rule}" for rule in DEVIATIONS]
    rules += [
        f"--suppress={name}"
        for name in ("missingIncludeSystem", "unusedStructMember", "knownConditionTrueFalse")
    ]
    checked = [tmp_path / "call.c", *([tmp_path / "model.c"] if kind == "1" else [])]
    succeed(
        "cppcheck", "--std=c99", "--enable=style", "--addon=misra", *rules, "--error-exitcode=1", *checked
    )


# what is written


def test_the_header_says_what_it_is(exported: Callable[..., Made]) -> None:
    safety_filter, directory = exported("own")
    head = (directory / "safety_filter.h").read_text()
    assert NOT_VERIFIED in head and "SAFETY_FILTER_VERIFIED 0" in head and VERSION in head
    assert f'VERSION "{VERSION}"' in head and f"version: {VERSION}" in Path("CITATION.cff").read_text()
    named = re.findall(r"SAFETY_FILTER_H_(\w+) = (\d+)", head)
    assert [(name.lower(), int(i)) for name, i in named] == [
        (re.sub(r"\W", "_", name).lower(), i) for i, name in enumerate(safety_filter.names)
    ]
    assert {status.name for status in Status} <= set(re.findall(r"SAFETY_FILTER_([A-Z]+) = \d", head))
    assert set(CONSTRAINTS) < set(safety_filter.names)


@pytest.mark.parametrize("name", ["main.c", "safety_filter.c", "safety_filter.h/"])
def test_what_is_not_a_filters_is_kept(name: str, tmp_path: Path) -> None:
    if name.endswith("/"):
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("/* years of work */\n")
    with pytest.raises(ValueError, match="holds no filter but"):
        write(made("1"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [name.removesuffix("/")]
