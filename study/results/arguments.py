"""What the programs that renew a page from a finished study are called with."""

from pathlib import Path

from settings import Parser


def of_a_study(program: str, files: str) -> Parser:
    """The parser of a program of this package, with --study and --out; `files`: what it writes there."""
    parser = Parser(prog=f"python -m {__package__}.{program}")
    parser.add_argument("--study", type=Path, required=True, help="directory of a finished study")
    parser.add_argument("--out", type=Path, required=True, help=f"directory for {files}")
    return parser
