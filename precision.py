"""Numbers that do not depend on the caller's PyTorch modes."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function ignore the caller's `torch.autocast` and `torch.inference_mode`.

    Autocast would round its matrix products to 8 bits; a tensor made in inference mode cannot be written into later.
    """

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        rounding = [device for device in ("cpu", "cuda") if torch.is_autocast_enabled(device)]
        if not rounding and not torch.is_inference_mode_enabled():
            return function(*args, **kwargs)
        with ExitStack() as modes:
            if torch.is_inference_mode_enabled():
                modes.enter_context(torch.inference_mode(False))
                modes.enter_context(torch.no_grad())  # inference mode implies it
            for device in rounding:
                modes.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return run
