"""C sources as WebAssembly, by the compiler of the package ziglang."""

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from settings import InputError

# no fused products, as in `kernels.build`, so that each operation rounds as it does in Python
FLAGS = (
    "-target",
    "wasm32-wasi",
    "-mexec-model=reactor",
    "-std=gnu11",
    "-O2",
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-tree-slp-vectorize",
    "-w",
    "-s",
)


def compiled(sources: Mapping[str, str]) -> bytes:
    """The WebAssembly module of C sources by name, which asks its surroundings for nothing.

    Raises:
        InputError: the compiler fails, or is not there (`study.play.page.check` says so earlier).
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as work:
        folder = Path(work)
        for name, text in sources.items():
            (folder / name).write_text(text, encoding="utf-8")
        units = [name for name in sources if name.endswith(".c")]
        command = [sys.executable, "-m", "ziglang", "cc", *FLAGS, *units, "-o", "play.wasm", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
        if done.returncode:
            said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
            reason = next((line for line in said if "error" in line), said[-1] if said else "no reason given")
            raise InputError(f"the compiler of ziglang failed ({done.returncode}): {reason}")
        return (folder / "play.wasm").read_bytes()
