"""An agent as C for the page: its network, what it observes, and the clusters of points left that this needs."""

from functools import partial

import torch
from torch import Tensor

from inspection.chief.points import (
    LLOYD_ITERATIONS,
    fibonacci_sphere,
    lloyd,
    max_clusters,
    nearest_cluster,
)
from inspection.model.parameters import InspectionParameters
from inspection.model.state import SIZE, P
from inspection.observation import observe
from kernels.printer import if_long, printed
from ppo.network import Policy
from rta.printed.source import define, for_one
from study.export.policy import sources
from study.play.printed import driver


def texts(policy: Policy, c: InspectionParameters) -> dict[str, str]:
    """The C sources by file."""
    normals = fibonacci_sphere(c.num_points)
    count = max_clusters(normals, c)
    sizes = [define("POINTS", c.num_points), define("CLUSTERS", count)]
    return {"clusters.c": of_clusters(c, normals, count, sizes), "agent.c": of_agent(policy, c, count, sizes)}


def of_clusters(c: InspectionParameters, normals: Tensor, count: int, sizes: list[str]) -> str:
    """The clusters, in single precision as `inspection.sight` has them."""
    # as in `inspection.sight`: coordinates whose sums are exact
    points = (c.chief_radius * normals * 2**13).round().div(2**13).float()
    centres, alive = torch.zeros(3, count, 1), torch.zeros(count, 1, dtype=torch.bool)
    wanted = torch.zeros(c.num_points, 1, dtype=torch.bool)
    part = printed(
        partial(lloyd, points),
        centres,
        wanted,
        alive,
        name="lloyd",
        names=(("centres", "wanted", "alive"), ("after", "size")),
        long=if_long(c.num_points),
    )
    assert part.real == "float"  # as `inspection.sight` computes it
    rows = ",\n".join(f"    {{{', '.join(f'{x!r}F' for x in row)}}}" for row in points.T.tolist())
    return "\n".join(
        [
            "#include <math.h>",
            *sizes,
            define("PER_CLUSTER", c.points_per_cluster),
            define("ITERATIONS", LLOYD_ITERATIONS),
            f"static const float points[POINTS][3] = {{\n{rows}\n}};",
            for_one([part]).replace("typedef double real;", "typedef float real;"),
            driver("clusters.c"),
        ]
    )


def of_agent(policy: Policy, c: InspectionParameters, count: int, sizes: list[str]) -> str:
    """The observation and the network."""
    x = torch.ones(SIZE, 1, dtype=torch.float64)
    centres, alive = x.new_zeros(3, count, 1), torch.zeros(count, 1, dtype=torch.bool)
    parts = [
        printed(
            nearest, centres, alive, x, name="nearest", names=(("centres", "alive", "x"), ("direction",))
        ),
        printed(
            partial(observed, c),
            x,
            x[:3],
            x[:3],
            x[0],
            name="observe",
            names=(("x", "priority", "left", "score"), ("o",)),
        ),
    ]
    network = sources(policy, c, "")
    text = network["policy.c"].replace('#include "policy.h"\n', network["policy.h"])
    return "\n".join([*sizes, text, for_one(parts), driver("agent.c")])


def nearest(centres: Tensor, alive: Tensor, x: Tensor) -> list[Tensor]:
    """r_UPS."""
    return [nearest_cluster(centres, alive, x[P])]


def observed(
    c: InspectionParameters, x: Tensor, priority: Tensor, left: Tensor, score: Tensor
) -> list[Tensor]:
    """The observation in physical units."""
    return [observe(x, priority, left, score, c)]
