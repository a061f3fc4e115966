"""What describes a run: its settings and where its numbers come from."""

import importlib.metadata
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from ppo.distributed import ranks
from study.config import Config
from study.experiment import resolve_device
from study.files import ROOT, write_json, write_text

PACKAGES = ("torch", "numpy", "piqp", "scipy", "tensorboard")


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
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
        "device": torch.cuda.get_device_name(device)
        if device.type == "cuda"
        else platform.processor() or "cpu",
        "threads": torch.get_num_threads(),
        "ranks": ranks().size,
    }


def write_settings(config: Config, directory: Path) -> None:
    """Writes what describes a run or a study: provenance.json and config.toml."""
    write_json(directory / "provenance.json", provenance(resolve_device(config.train.device)))
    write_text(directory / "config.toml", config.to_toml())
