"""A directory that C is written into: it may hold what was written there before, and nothing else."""

from collections.abc import Collection
from pathlib import Path


def check_directory(
    directory: Path, kind: str, mark: str, written: Collection[str], built: Collection[str]
) -> None:
    """Refuses a directory in which anything of somebody else's could be lost; one that is not there is fine.

    Args:
        kind: what is written there, in words; mark: what stands on the first line of each file.
        written: the files' names; built: the names of what is built of them, whatever it holds.

    Raises:
        ValueError: it holds anything else; OSError: it cannot be read.
    """
    for path in sorted(directory.iterdir()) if directory.exists() else ():
        if path.name not in built and not (path.name in written and is_own(path, mark)):
            raise ValueError(f"{directory}: holds no {kind} but {path.name}; name a new directory")


def is_own(path: Path, mark: str) -> bool:
    """Whether a file has the mark on its first line, or is empty, as one whose writing was cut off."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.readline(200)
    return mark.encode() in head or not head
