"""Which device tensors live on."""

import torch

from ppo.torchrun import local_rank
from settings import InputError


def resolve_device(name: str) -> torch.device:
    """The device for auto, cpu or cuda."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "device cuda: no CUDA device is available here; allowed are auto and cpu (--device cpu)"
        )
    device = torch.device(
        "cuda" if name == "auto" and torch.cuda.is_available() else name.replace("auto", "cpu")
    )
    if device.type == "cuda" and local_rank() > 0:  # each rank of a machine has a device of its own
        devices = torch.cuda.device_count()
        if local_rank() >= devices:
            raise InputError(f"device cuda: {devices} here, too few for rank {local_rank()} of this machine")
        torch.cuda.set_device(local_rank())
    return device
