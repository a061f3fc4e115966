"""The relative ellipses that the guidance follows around the chief, by name."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from torch import Tensor

Knob: TypeAlias = "float | Tensor"  # a number, or (B,), one per episode


@dataclass(frozen=True)
class Lead:
    """The phase of `natural_motion` from the Sun's, by the inspected score: behind it at first, ahead of it later.

    Points go dark behind the Sun and become lit ahead of it. So who looks behind first and ahead later sees more.

    Attributes:
        behind, ahead: rad, at first and at last.
        begin, end: the scores between which the phase moves, linearly.
    """

    behind: Knob
    ahead: Knob
    begin: Knob = 0.0
    end: Knob = 0.95

    def at(self, score: "Tensor") -> "Tensor":
        """How far ahead of the Sun's the phase is, (B,) rad, once a weight (B,) has been inspected."""
        share = ((score - self.begin) / (self.end - self.begin)).clamp(0.0, 1.0)
        return share * (self.behind + self.ahead) - self.behind


@dataclass(frozen=True)
class Orbit:
    """The relative ellipse that `natural_motion` follows, and how it gets there; each number may be one per episode.

    Attributes:
        semi_minor: b in m; the ellipse is twice as long along the track.
        out_of_plane: a in m, its amplitude out of the orbital plane.
        tracking: rad/s, frequency of the critically damped law that tracks it: short ways cost fuel.
        look_ahead: rad of phase, L. The chord between two points so far apart keeps b cos(L / 2) from the chief.
        approach: the fastest that it nears the orbit, as a share of the dynamic speed limit.
        lead: where on it; None: at the Sun's phase.
    """

    semi_minor: Knob = 40.0
    out_of_plane: Knob = 0.0
    tracking: Knob = 0.006
    look_ahead: Knob = math.pi / 3
    approach: Knob = math.inf
    lead: Lead | None = None


# What flies and teaches by name. "following": a larger ellipse sees more of the chief at once; its tilt, a wider way
# there and 70 % of the dynamic speed limit keep away from every limit. The others lead the Sun, from thrifty to quick;
# `study.results.guidance_search` has found their knobs, and `study.results.guidance_front` flies what nobody has seen.
GUIDANCE: dict[str, Orbit] = {
    "natural-motion": Orbit(),
    "following": Orbit(
        semi_minor=55.0, out_of_plane=30.0, tracking=0.01, look_ahead=math.pi / 6, approach=0.7
    ),
    "thrifty": Orbit(58.81, 21.12, 0.003456, 0.7719, 0.1981, Lead(1.109, 0.5218, 0.103, 0.9366)),
    "calm": Orbit(54.6, 19.92, 0.004407, 0.6739, 0.3036, Lead(1.024, 0.7562, 0.2549, 0.9602)),
    "even": Orbit(54.2, 19.12, 0.006099, 0.7179, 0.4683, Lead(0.7902, 0.6877, 0.2279, 1.027)),
    "brisk": Orbit(63.08, 19.97, 0.006164, 0.9743, 0.6111, Lead(0.9664, 0.4398, 0.3082, 0.8023)),
    "quick": Orbit(57.36, 18.24, 0.009869, 0.9396, 0.6374, Lead(0.8342, 0.9062, 0.408, 0.9634)),
}
