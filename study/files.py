"""Files written whole or not at all, and what describes a run: its settings and where its numbers come from."""

import importlib.metadata
import json
import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from ppo.distributed import ranks
from study import experiment as build
from study.config import Config

ROOT = Path(__file__).parent.parent  # of the repository
PACKAGES = ("torch", "numpy", "piqp", "scipy", "tensorboard")


def write_text(path: Path, text: str) -> None:
    """Writes beside `path` and renames, so that a kill at any moment leaves the old file or the new one."""
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes content as indented JSON, whole or not at all."""
    write_text(path, json.dumps(content, indent=2) + "\n")


def git_revision() -> str:
    """The commit of the source tree, marked if modified; "unknown" outside a repository."""
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
    """Writes what describes a run or a study: config.toml and provenance.json."""
    write_json(directory / "provenance.json", provenance(build.resolve_device(config.train.device)))
    write_text(directory / "config.toml", config.to_toml())
