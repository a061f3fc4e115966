"""The solvers by the names that `--qp-solver` has for them."""

from rta.qp.active_set import ActiveSet
from rta.qp.piqp_solver import PiqpSolver
from rta.qp.programs import Solver

SOLVERS: dict[str, type[Solver]] = {"piqp": PiqpSolver, "batched": ActiveSet}


def make_solver(name: str) -> Solver:
    """Makes a new solver."""
    return SOLVERS[name]()
