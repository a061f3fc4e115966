"""What PyTorch's operations do to arrays of scalar values: arithmetic is written out, views cost nothing."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy import ndarray

from kernels.operations.expressions import Program, Value
from kernels.operations.reductions import Reductions
from kernels.operations.scalars import scalars
from kernels.operations.shapes import Axes, Shapes, filled, objects


class Operations:
    """The operations of one program.

    Args:
        program: takes the expressions.
        long: length of the axis that is looped over instead of written out; 0: none is.

    Attributes:
        axes: know the shapes of the tensors that the next operation is of.
        views: names of operations whose result shares its memory with what it is of.
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
        """An operation, by its name in PyTorch, of arrays and plain arguments.

        Raises:
            NotImplementedError: it is not there, or not for these arguments; says why not.
        """
        if name not in self.by_name:
            raise NotImplementedError("")
        try:
            return self.by_name[name](*arguments, **options)
        except (
            TypeError,
            ValueError,
            IndexError,
        ) as error:  # options that it does not know, or the long axis
            raise NotImplementedError(f"with these arguments ({error})") from error


def elementwise(function: Callable[..., Value]) -> Callable[..., ndarray]:
    """A function of values as one of arrays, which broadcast."""

    def run(*arrays: Any, **options: Any) -> ndarray:
        columns = np.broadcast(*map(objects, arrays))
        return filled([function(*each, **options) for each in columns], columns.shape)

    return run
