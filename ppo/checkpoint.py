"""Checkpoints: tensors and plain values only, written atomically."""

import io
import warnings
from pathlib import Path
from typing import Any

import torch

from ppo.errors import CheckpointError
from ppo.files import naming, replacing


def save(path: Path, content: dict[str, Any]) -> None:
    """Writes a checkpoint, so that a kill at any moment leaves a whole file.

    Raises:
        OSError: it cannot be written. The message names the file; the old file remains, and no other file beside it.
    """
    buffer = io.BytesIO()
    torch.save(content, buffer)  # into memory first: on a full disk torch would end the process
    with naming(path), replacing(path) as file:
        file.write(buffer.getbuffer())


def load(path: str | Path, keys: tuple[str, ...], device: str | torch.device = "cpu") -> dict[str, Any]:
    """Reads a checkpoint with weights_only=True and checks that it holds `keys`.

    Raises:
        CheckpointError: with a one-line reason.
    """
    if Path(path).is_dir():
        raise CheckpointError(
            f"{path}: is a directory; name a file in it, such as {Path(path) / 'policy.pt'}"
        )
    if not Path(path).is_file():
        raise CheckpointError(f"{path}: no such checkpoint file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damage is reported below, in one line
            content = torch.load(path, map_location=device, weights_only=True)
    except (OSError, RuntimeError) as error:  # the system's or torch's own message says what is wrong
        reason = str(error).splitlines()[0].partition(". ")[0][:120]
        raise CheckpointError(f"{path}: not a readable checkpoint ({reason})") from None
    except Exception:  # other bytes, read as pickle, raise errors without a useful message
        raise CheckpointError(
            f"{path}: not a readable checkpoint: damaged, or no policy.pt or checkpoint.pt of train"
        ) from None
    missing = [key for key in keys if not isinstance(content, dict) or key not in content]
    if missing:
        raise CheckpointError(f"{path}: not a checkpoint of this program: it lacks {', '.join(missing)}")
    return content
