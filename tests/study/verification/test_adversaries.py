"""What flies behind the filter in a verification: random controls and the adversary."""

import numpy as np
import torch
from scipy.stats import kstest

from inspection.model.parameters import InspectionParameters
from rta.filter import SafetyFilter
from rta.parameters import RtaParameters
from study.verification.adversaries import LONGEST_ACTION, adversarial, held_at_random
from tests.rta.conditions.test_rows import LIMIT, ROWS, flights
from tests.rta.constraints.test_constraints import tensor
from tests.rta.test_lie_derivatives import held, push, slope

C = InspectionParameters()
R = RtaParameters()


def test_random_controls_are_held_for_up_to_a_minute() -> None:
    count, steps = 50, 400
    policy = held_at_random(C, torch.Generator().manual_seed(3), count)
    part = held_at_random(C, torch.Generator().manual_seed(3), count, 10)
    x = torch.zeros(16, count, dtype=torch.float64)
    u = torch.stack([policy(float(t), x) for t in range(steps)]).numpy()
    assert all((part(float(t), x[:, :5]).numpy() == u[t][:, 10:15]).all() for t in range(steps))
    assert (np.abs(u) <= LIMIT).all() and (np.abs(u).max((0, 2)) > 0.99 * LIMIT[:, 0]).all()
    changes = (np.diff(u, axis=0) != 0).any(1)
    assert (changes == (np.diff(u, axis=0) != 0).all(1)).all()  # all six at once
    holds = np.concatenate([np.diff(np.flatnonzero(changes[:, k])) for k in range(count)])
    assert holds.min() >= 1 and holds.max() <= LONGEST_ACTION
    assert (
        kstest((holds - np.random.default_rng(0).random(holds.size)) / LONGEST_ACTION, "uniform").pvalue
        > 1e-4
    )


def test_adversary_descends_the_row_that_zero_control_comes_closest_to_breaking() -> None:
    x = flights(2000, (16, 790), (0.05, 0.95))
    safety = SafetyFilter(C, R)
    u = adversarial(safety)(0.0, tensor(x)).numpy()
    np.testing.assert_allclose(np.abs(u[:3]).max(0), 1.0)
    np.testing.assert_allclose(np.abs(u[3:]).max(0), C.max_torque)
    thrust, _ = safety.rows(tensor(x))
    worst = (thrust.b / thrust.a.norm(dim=1)).argmin(0).numpy()
    barriers = {row: h for row, *_, h, _ in ROWS.values()}
    seen = 0
    for row, h in barriers.items():
        y = x[:, worst == row]
        if y.size:
            gradient = np.stack([slope(h, y, push(held(y), i), 1e-3) for i in range(3)])
            np.testing.assert_allclose(u[:3, worst == row], -gradient / np.abs(gradient).max(0), atol=1e-6)
            assert (h(y + 1e-3 * sum(u[i, worst == row] * push(held(y), i) for i in range(3))) < h(y)).all()
            seen += y.shape[1]
    assert seen > 300
