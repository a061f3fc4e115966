"""Common parts of all exported C: a prefix, refused flags, and a directory that holds nothing else."""

import re
from collections.abc import Collection
from pathlib import Path

# Compilers define these macros if they may assume that no number is NaN: gcc, clang and icx with -ffast-math, -Ofast or
# -ffinite-math-only, Microsoft's with /fp:fast. clang's -fno-honor-nans alone defines no macro.
REFUSES_FAST_MATH = """#if defined(__FAST_MATH__) || defined(_M_FP_FAST) || \\
    (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ != 0))
#error "{name} must see NaN: compile it without -ffast-math, -Ofast, -ffinite-math-only and /fp:fast"
#endif"""


TAKEN = re.compile(  # by C and C++, and by math.h
    "and|asm|auto|bool|break|case|catch|char|class|const|continue|default|delete|do|double|else|enum|extern|false|float|"
    "for|friend|goto|if|inline|int|long|main|mutable|namespace|new|not|operator|or|private|protected|public|register|"
    "restrict|return|short|signed|sizeof|static|struct|switch|template|this|throw|true|try|typedef|typename|union|"
    "unsigned|using|virtual|void|volatile|while|xor|a?(cos|sin|tan)h?|atan2|cbrt|ceil|copysign|erfc?|exp2?|expm1|fabs|fdim|"
    "floor|fma|fmax|fmin|fmod|frexp|gamma|hypot|ilogb|is(finite|inf|nan|normal)|[jy][01n]|ldexp|lgamma|log(10|1p|2|b)?|"
    "l?l?r(int|ound)|modf|nan|nearbyint|pow|remainder|round|scalb|signbit|sqrt|tgamma|trunc|"
    "abort|abs|atoi|calloc|exit|f?puts|free|labs|malloc|[fs]?n?printf|f?(open|close|read|write)|remove|rename|std(in|out|err)|"
    "system"
)


def check_prefix(prefix: str) -> None:
    """Raises ValueError if files, functions, types and macros of C cannot begin with the prefix."""
    if not re.fullmatch("[a-z][a-z0-9_]*", prefix) or TAKEN.fullmatch(prefix):
        raise ValueError(
            f"{prefix!r}: must be a name in C of lower-case letters, digits and _ that begins with a letter, and no "
            "word or function of C's"
        )


def prefixed(text: str, name: str, prefix: str) -> str:
    """Returns a text, or a file's name, with `name` replaced by the prefix.

    Raises ValueError if something else in the text has the prefix as its name.
    """
    if prefix != name and re.search(rf"\b{prefix}\b", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)):
        raise ValueError(f"{prefix!r}: is the name of something else in it; give another")
    return text.replace(name, prefix).replace(name.upper(), prefix.upper())


def check_directory(
    directory: Path, kind: str, mark: str, written: Collection[str], built: Collection[str]
) -> None:
    """Raises an error for a directory in which somebody else's files could be lost; a missing directory is fine.

    Args:
        kind: what is written there, in words; mark: text on the first line of each file.
        written: the files' names; built: the names of files built from them, with any content.

    Raises:
        ValueError: it holds anything else; OSError: it cannot be read.
    """
    for path in sorted(directory.iterdir()) if directory.exists() else ():
        if path.name not in built and not (path.name in written and is_own(path, mark)):
            raise ValueError(f"{directory}: holds no {kind} but {path.name}; name a new directory")


def is_own(path: Path, mark: str) -> bool:
    """Checks whether a file has the mark on its first line, or is empty because its writing was interrupted."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.readline(200)
    return mark.encode() in head or not head
