"""PyTorch's operations on arrays of scalar values: arithmetic is written out, views cost nothing."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray

from kernels.operations.expressions import Program, Value
from kernels.operations.reductions import Reductions
from kernels.operations.scalars import scalars
from kernels.operations.shapes import Axes, Shapes, filled, objects


class Operations:
    """Applies the operations of one program.

    Args:
        program: collects the expressions.
        long: length of the axis that is looped over instead of written out; 0: none is.

    Attributes:
        axes: hold the shapes of the operands of the next operation.
        views: names of operations whose result shares memory with its operand.
    """

    def __init__(self, program: Program, long: int = 0) -> None:
        self.axes = Axes(long)
        shapes = Shapes(program, self.axes)
        self.views = frozenset(shapes.views)
        self.by_name: dict[str, Callable[..., Any]] = {
            **{name: elementwise(function) for name, function in scalars(program).items()},
            **shapes.views,
            **shapes.others,
            **Reductions(program, self.axes, self.call).by_name,
        }

    def call(self, name: str, *arguments: Any, **options: Any) -> Any:
        """Applies an operation, by its name in PyTorch, to arrays and plain arguments.

        Raises:
            NotImplementedError: it is not supported, or not for these arguments; says why.
        """
        if name not in self.by_name:
            raise NotImplementedError("")
        try:
            return self.by_name[name](*arguments, **options)
        except (TypeError, ValueError, IndexError) as error:  # for unknown options, or along the long axis
            raise NotImplementedError(f"with these arguments ({error})") from error


def elementwise(function: Callable[..., Value]) -> Callable[..., ndarray]:
    """Returns a function of values as a function of arrays, which broadcast."""

    def run(*arrays: Any, **options: Any) -> ndarray:
        columns = np.broadcast(*map(objects, arrays))
        return filled([function(*each, **options) for each in columns], columns.shape)

    return run
