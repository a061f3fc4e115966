"""How far a position and a velocity may be from what they are taken for, and the least that depends on them.

Each lies in a box around its estimate, what a sensor is told to be wrong by on each axis, widened by a ball, what a
prediction is. Of a vector a' in such a set around a, with half widths d and radius e, for any direction n,

    n . a' >= n . a - (d |n|_1 + e |n|)         `support`
    |a'|   <= | |a| + d | + e                   `longest`, exact

and of its direction a' / |a'| to that of a the angle has a sine of at most (sqrt(3) d + e) / |a|, `astray`.
"""

from typing import NamedTuple

from torch import Tensor

from inspection.model.attitude import dot, norm
from inspection.model.parameters import Limits
from inspection.model.state import P, V

TINY = 1e-24  # keeps the slope of a length finite at zero, far below any that matters


class Set(NamedTuple):
    """Where a vector may be around its estimate.

    Attributes:
        box: half its width along each axis; ball: (...) radius of what is added to it.
    """

    box: float
    ball: Tensor

    @property
    def radius(self) -> Tensor:
        """Of the ball around all of it."""
        return self.box * 3.0**0.5 + self.ball

    def support(self, n: Tensor) -> Tensor:
        """By how much n . a can be off, of directions (3, ...) of any length."""
        return self.box * n.abs().sum(0) + self.ball * (dot(n, n) + TINY).sqrt()

    def longest(self, a: Tensor) -> Tensor:
        """The largest length of what a (3, ...) may be."""
        wide = a.abs() + self.box
        return (dot(wide, wide) + TINY).sqrt() + self.ball


class Errors(NamedTuple):
    """How far a state may be off in Hill's frame.

    Attributes:
        position: in m; velocity: in m/s.
        impulse: m/s, at most, what thrust has added otherwise; the rows' slopes have what that does to first order.
    """

    position: Set
    velocity: Set
    impulse: Tensor | float = 0.0

    def astray(self, x: Tensor) -> Tensor:
        """The largest sine of the angle between where the chief is seen and where it is; states (16, ...) to (...)."""
        return (self.position.radius / norm(x[P])).clamp(max=1.0)

    def least_distance(self, x: Tensor) -> Tensor:
        """m, of the spacecraft from the chief's centre at least; states (16, ...) to (...)."""
        distance = norm(x[P])
        return distance - self.position.support(x[P] / distance)

    def radial_speed(self, x: Tensor) -> Tensor:
        """m/s, by how much v . p / |p| may be more or less; states (16, ...) to (...).

        With n' the true direction, phi from n: |v . (n' - n)| <= v_t sin(phi) + |v_r| (1 - cos(phi)), and what the
        velocity's error does along n' - n is at most its radius times |n' - n| <= sqrt(2) sin(phi).
        """
        n, sine = x[P] / norm(x[P]), self.astray(x)
        radial = dot(x[V], n)
        seen = self.across(x) * sine + radial.abs() * sine**2
        return self.velocity.support(n) + seen + 2.0**0.5 * sine * self.velocity.radius

    def across(self, x: Tensor) -> Tensor:
        """m/s, the speed across p; states (16, ...) to (...)."""
        radial = dot(x[V], x[P]) / norm(x[P])
        return ((dot(x[V], x[V]) - radial**2).clamp(min=0.0) + TINY).sqrt()

    def most_across(self, x: Tensor) -> Tensor:
        """m/s, the speed across p at most; states (16, ...) to (...)."""
        turned = 2.0**0.5 * self.astray(x) * norm(x[V])
        return self.across(x) + turned + self.velocity.radius + self.impulse


def after(start: Errors, seconds: float, c: Limits, impulse: Tensor) -> Errors:
    """The errors after a hold of so many s.

    A velocity's error moves the position, the natural acceleration of a state that is off is off by its own gradient
    times that (`Limits.largest_drift`), and an `impulse` in m/s of thrust or of what else pushes, spread over the hold,
    moves the position by half of what it would if it came at once. What it adds to the velocity is not counted: the
    rows' slopes have it.
    """
    far = 2.0 * c.max_distance  # the gradient of what is of second order in the distance is twice its share
    position, velocity = start.position.radius, start.velocity.radius
    drift = (c.largest_drift(far, 0.0) / far * position + c.largest_drift(0.0, 1.0) * velocity) * seconds
    moved = start.velocity.ball * seconds + (drift + impulse) * seconds / 2.0
    return Errors(
        Set(start.position.box + start.velocity.box * seconds, start.position.ball + moved),
        Set(start.velocity.box, start.velocity.ball + drift),
        impulse,
    )
