"""Settings of the filter. Gains and weights are in `rta.limits`, beside their limits."""

from dataclasses import dataclass

from settings import Settings, setting

FILTERS = ("checked", "paper")
PERIODS = (1.0, 5.0, 10.0)
QP_SOLVERS = ("auto", "piqp", "batched")


@dataclass(frozen=True)
class RtaParameters(Settings):
    """Holds which filter is used, how often it is called, and what solves its programs."""

    filter: str = setting(
        "checked",
        "which filter (checked: a control is applied only after its check; paper: the paper's program alone, which can "
        "fail)",
        among=FILTERS,
    )
    period: float = setting(1.0, "s between two calls of the filter", among=PERIODS)
    qp_solver: str = setting(
        "auto",
        "solver of the quadratic programs; auto: piqp for the paper's filter, batched for the checked one",
        among=QP_SOLVERS,
    )
    unverified: bool = setting(
        False, "fly a vehicle or error bounds for which no check is known, with the paper's program only"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.filter == "paper" and self.qp_solver == "batched":
            raise ValueError('qp_solver = "batched": must be "piqp" or "auto" with filter = "paper"')

    @property
    def solver(self) -> str:
        """Returns the solver that is used: "piqp" or "batched"."""
        auto = "piqp" if self.filter == "paper" else "batched"
        return auto if self.qp_solver == "auto" else self.qp_solver
