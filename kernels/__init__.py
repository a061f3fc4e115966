"""Functions of a batch made fast: traced, printed as C, built and loaded. It knows nothing of spacecraft."""

from kernels.build import NoCompilerError
from kernels.compiled import Compiled
from kernels.printer import Printed, printed

__all__ = ["Compiled", "NoCompilerError", "Printed", "printed"]
