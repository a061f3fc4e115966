"""Functions of a batch made fast: recorded, printed as C, built and loaded. It knows nothing of spacecraft."""

from typing import TYPE_CHECKING

from on_demand import on_demand

if TYPE_CHECKING:
    from kernels.build import NoCompilerError, library
    from kernels.compiled import Compiled, Kernel, batch
    from kernels.printer import Printed, if_long, printed

__all__ = ["Compiled", "Kernel", "NoCompilerError", "Printed", "batch", "if_long", "library", "printed"]

__getattr__ = on_demand(
    __name__,
    {
        "NoCompilerError": "kernels.build.NoCompilerError",
        "library": "kernels.build.library",
        "Compiled": "kernels.compiled.Compiled",
        "Kernel": "kernels.compiled.Kernel",
        "batch": "kernels.compiled.batch",
        "Printed": "kernels.printer.Printed",
        "if_long": "kernels.printer.if_long",
        "printed": "kernels.printer.printed",
    },
)
