"""What describes a run: its settings and where its numbers come from."""

import hashlib
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from ppo.distributed import ranks
from settings import to_toml
from study.config import Config
from study.files import ROOT, write_json, write_text
from study.machine.device import resolve_device
from study.machine.threads import THREADS

MOST_THREADS = (
    4096  # that any machine was used with; so many more that they cannot be started end the process
)
PACKAGES = ("numpy", "piqp", "scipy", "tensorboard")  # beside PyTorch


def git_revision() -> str:
    """The commit of the source tree, marked if modified; "unknown" outside a repository."""
    if not (ROOT / ".git").exists():  # installed, maybe below somebody else's repository
        return "unknown"
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40"],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
        return described.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def provenance(device: torch.device) -> dict[str, Any]:
    """What else determines a run's numbers, beside its configuration."""
    return {
        "git_revision": git_revision(),
        "python": platform.python_version(),
        "packages": {"torch": torch.__version__}  # which says of which build, too
        | {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(device)
        if device.type == "cuda"
        else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "ranks": ranks().size,
    }


def write_settings(config: Config, directory: Path, init_from: Path | None = None) -> None:
    """Writes what describes a run or a study: provenance.json, with the file it started from, then config.toml."""
    THREADS.settle()  # before they are recorded
    about = provenance(resolve_device(config.train.device))
    if init_from:
        digest = hashlib.sha256(init_from.read_bytes()).hexdigest()
        about["init_from"] = {"file": str(init_from), "sha256": digest}
    write_json(directory / "provenance.json", about)
    write_text(directory / "config.toml", to_toml(config))


def recorded_threads(directory: Path) -> int | None:
    """The threads that provenance.json says a run or a study was begun with; None where it does not say."""
    try:
        recorded = json.loads((directory / "provenance.json").read_text(encoding="utf-8"))["threads"]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return recorded if type(recorded) is int and 0 < recorded <= MOST_THREADS else None
