"""Functions of a batch made fast: traced, printed as C, built and loaded. It knows nothing of spacecraft."""

from kernels.build import NoCompilerError, library
from kernels.compiled import Compiled, Kernel, batch
from kernels.printer import Printed, printed

__all__ = ["Compiled", "Kernel", "NoCompilerError", "Printed", "batch", "library", "printed"]
