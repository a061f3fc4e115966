"""Names of a package that are imported when they are asked for: PyTorch, which most of them need, takes seconds."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def on_demand(package: str, places: Mapping[str, str]) -> Callable[[str], Any]:
    """The `__getattr__` of a package.

    Args:
        places: by the name that the package offers, where it is: "module.name".
    """

    def find(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, own = places[name].rpartition(".")
        return getattr(import_module(module), own)

    return find
