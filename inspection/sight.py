"""What a batch of episodes has seen of the chief: the inspected points, and where the nearest lit ones are left."""

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor

from columns import LEAST_LONG
from inspection.chief import points as chief
from inspection.chief.surface import directions, groups, in_view, seen_from, surface
from inspection.chief.tumbling import RATE, Tumbling
from inspection.model.attitude import conjugate, rotate
from inspection.model.parameters import ChiefParameters, InspectionParameters
from inspection.model.state import P
from precision import in_full_precision

ALL = slice(None)  # of the batch's columns


class Sight:
    """Keeps what the deputies of a batch of episodes have seen of their chiefs.

    Args:
        target: the chief; c: the task; batch: episodes, B.

    Attributes:
        surface: of N points, in the chief's frame.
        tumbling: how the chiefs turn; None: the chief is the paper's, its frame Hill's.
        priority: (3, B) in the chief's frame; weights: (N, B) of the points, which follow from it.
        inspected: (N, B) bool.
        centres, alive: (3, K, B) m and (K, B) bool, the clusters of lit uninspected points, see `chief.points.cluster`.
        uninspected: r_UPS (3, B) in Hill's frame.
    """

    STATE = ("priority", "weights", "inspected", "centres", "alive", "uninspected")

    def __init__(
        self, target: ChiefParameters, c: InspectionParameters, batch: int, device: torch.device
    ) -> None:
        self.c = c
        self.tumbling: Tumbling | None = None
        if not target.is_the_papers or "chief" in c.observed:
            self.tumbling = Tumbling(target, c, batch, device)
        self.surface = surface(target, c, device)
        # k-means runs in float32 on coordinates rounded to 2^-13 m, because these sum exactly in any order
        self.points = (self.surface.points * 2**13).round().div(2**13).float()
        count = self.points.shape[1]
        clusters = chief.max_clusters(self.surface.normals, c, self.tumbling is not None)
        self.priority = torch.zeros(3, batch, dtype=torch.float64, device=device)
        self.uninspected = self.priority.new_zeros(3, batch)
        self.weights = self.priority.new_zeros(count, batch)
        self.inspected = self.priority.new_zeros(count, batch, dtype=torch.bool)
        self.centres = self.priority.new_zeros(3, clusters, batch, dtype=torch.float32)
        self.alive = self.priority.new_zeros(clusters, batch, dtype=torch.bool)
        # functions of states column by column, which `compile` replaces
        whole = (
            partial(in_view, self.surface) if self.tumbling else partial(chief.in_view, self.surface.normals)
        )
        self._in_view = partial(whole, c=c)
        self._seen: Callable[..., list[Tensor]] = partial(
            chief.by_chunks, lambda *given: [self._in_view(*given)]
        )
        self._settle: Callable[..., list[Tensor]] = partial(
            chief.by_chunks, partial(chief.settled, self.points)
        )

    def begin(self, columns: Tensor, x: Tensor, priority: Tensor, number: Tensor | None) -> None:
        """Begins episodes in the given columns; points visible at the start count as inspected.

        Args:
            x: states (16, k); priority: (3, k); number: (k,) in [0, 1), from which the chiefs' motion follows.
        """
        if self.tumbling:
            self.tumbling.begin(columns, number)
        for name in self.STATE:
            getattr(self, name)[..., columns] = 0
        self.priority[:, columns] = priority
        self.weights[:, columns] = chief.point_weights(self.surface.normals, priority, self.surface.areas)
        self.update_inspected(x, columns)

    @in_full_precision
    def look(self, x: Tensor, time: Tensor) -> None:
        """Looks at every chief from states x (16, B), at the episodes' time (B,) in s."""
        if self.tumbling:
            self.tumbling.at(time)
        self.update_inspected(x)

    def update_inspected(self, x: Tensor, columns: Tensor | slice = ALL) -> None:
        """Marks the points in view from states x (16, k) as inspected.

        r_UPS then points at the nearest cluster of lit uninspected points.
        """
        ((lit, seen),) = self._seen(x, *self._frames(columns))
        inspected = self.inspected[:, columns] | seen
        wanted = lit & ~inspected
        centres, alive = chief.cluster(
            self.points,
            wanted,
            self.centres[..., columns],
            self.alive[:, columns],
            self.c.points_per_cluster,
            self._settle,
        )
        self.inspected[:, columns] = inspected
        self.centres[..., columns] = centres
        self.alive[:, columns] = alive
        if self.tumbling:
            attitude = self.tumbling.attitude[:, columns]
            p = rotate(conjugate(attitude), x[P])
            direction = rotate(attitude, chief.nearest_cluster(centres.to(x.dtype), alive, p))
        else:
            direction = chief.nearest_cluster(centres.to(x.dtype), alive, x[P])
        self.uninspected[:, columns] = direction

    def score(self, columns: Tensor | slice = ALL) -> Tensor:
        """Returns w_p (k,), the inspected weight of the given columns."""
        return torch.where(self.inspected[:, columns], self.weights[:, columns], 0.0).sum(0)

    def left(self, columns: Tensor | slice = ALL) -> tuple[Tensor, Tensor]:
        """Returns points in Hill's frame, (3, N, 1) or, if chiefs turn, (3, N, k), and their weights left (N, k)."""
        points = self.surface.points[..., None]
        if self.tumbling:
            points = rotate(self.tumbling.attitude[:, None, columns], points)
        return points, self.weights[:, columns].masked_fill(self.inspected[:, columns], 0.0)

    def observed(self, columns: Tensor | slice = ALL, score: Tensor | None = None) -> tuple[Tensor, ...]:
        """Returns what an agent observes beside its state, as `observation.normalised` takes it.

        These are r_p and r_UPS (3, k) in Hill's frame, w_p (k,) and, if it is observed, the chief's attitude and rate
        (7, k).

        Args:
            score: `score` of these columns, if it is known.
        """
        priority = self.priority[:, columns]
        if self.tumbling:
            priority = rotate(self.tumbling.attitude[:, columns], priority)
        score = self.score(columns) if score is None else score
        shown = priority, self.uninspected[:, columns], score
        if self.tumbling and "chief" in self.c.observed:
            return *shown, self.tumbling.motion[: RATE.stop, columns]
        return shown

    def compile(self, compiled: Callable[..., Any], x: Tensor) -> None:
        """Compiles visibility and k-means; if the compiler raises, nothing is changed.

        Args:
            compiled: `InspectionEnv._several`; x: states (16, B).
        """
        seen = self._looking(compiled, x, *self._frames(ALL))
        settle = compiled(partial(chief.lloyd, self.points), self.centres, self.inspected, self.alive)
        self._seen, self._settle = seen, partial(settle, times=chief.LLOYD_ITERATIONS)

    def _looking(self, compiled: Callable[..., Any], *examples: Tensor) -> Callable[..., list[Tensor]]:
        """Returns the function that sees the points, compiled for tensors like the examples.

        For a mesh, each group of points is compiled by itself.
        """
        if not self.tumbling:
            return compiled(lambda *given: [self._in_view(*given)], *examples)
        where = compiled(lambda *given: [directions(*given)], *examples)
        runs = []
        for part, count in groups(self.surface, LEAST_LONG):
            run = compiled(
                lambda seen, part=part: [seen_from(part, seen, self.c)],
                *where(*examples),
                points=len(part.areas),
            )
            runs.append((run, count))

        def look(*given: Tensor) -> list[Tensor]:
            seen = where(*given)
            return [torch.cat([run(*seen)[0][:, :count] for run, count in runs], 1)]

        return look

    def _frames(self, columns: Tensor | slice) -> tuple[Tensor, ...]:
        """Returns the attitude (4, k) of the given chiefs, if it is not Hill's frame."""
        return (self.tumbling.attitude[:, columns],) if self.tumbling else ()
