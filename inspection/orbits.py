"""The relative ellipses that the guidance follows around the chief, by name."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from torch import Tensor

Knob: TypeAlias = "float | Tensor"  # one number, or (B,) one per episode


@dataclass(frozen=True)
class Lead:
    """Describes the phase of `natural_motion` relative to the Sun's by the inspected score: first behind, later ahead.

    Points go dark behind the Sun and become lit ahead of it. So a deputy that looks behind first and ahead later sees
    more.

    Attributes:
        behind, ahead: rad, at first and at last.
        begin, end: the scores between which the phase moves, linearly.
    """

    behind: Knob
    ahead: Knob
    begin: Knob = 0.0
    end: Knob = 0.95

    def at(self, score: "Tensor") -> "Tensor":
        """Returns by how much the phase is ahead of the Sun's, (B,) rad, for an inspected weight (B,)."""
        share = ((score - self.begin) / (self.end - self.begin)).clamp(0.0, 1.0)
        return share * (self.behind + self.ahead) - self.behind


@dataclass(frozen=True)
class Orbit:
    """Describes the relative ellipse that `natural_motion` follows, and its approach; numbers may differ by episode.

    Attributes:
        semi_minor: b in m; the ellipse is twice as long along the track.
        out_of_plane: a in m, its amplitude out of the orbital plane.
        tracking: rad/s, frequency of the critically damped law that tracks it; direct approaches cost fuel.
        look_ahead: rad of phase, L. The chord between two points that far apart stays b cos(L / 2) from the chief.
        approach: the largest approach speed, as a share of the dynamic speed limit.
        lead: where on the ellipse; None: at the Sun's phase.
    """

    semi_minor: Knob = 40.0
    out_of_plane: Knob = 0.0
    tracking: Knob = 0.006
    look_ahead: Knob = math.pi / 3
    approach: Knob = math.inf
    lead: Lead | None = None


# The guidance settings by name. "following": a larger ellipse sees more of the chief at once; its tilt, a wide approach
# and 70 % of the dynamic speed limit stay away from every limit. The others lead the Sun, from thrifty to quick: a
# search for time against fuel found their numbers, and `experiments.guidance` flies cases outside that search.
GUIDANCE: dict[str, Orbit] = {
    "natural-motion": Orbit(),
    "following": Orbit(
        semi_minor=55.0, out_of_plane=30.0, tracking=0.01, look_ahead=math.pi / 6, approach=0.7
    ),
    "thrifty": Orbit(52.91, 16.32, 0.004475, 0.5698, 0.4246, Lead(0.9712, 0.9242, 0.2988, 1.128)),
    "calm": Orbit(57.36, 15.54, 0.005793, 0.7627, 0.2911, Lead(0.8259, 0.8441, 0.2744, 1.095)),
    "even": Orbit(56.88, 16.18, 0.006578, 0.7525, 0.3837, Lead(0.8978, 0.8653, 0.3076, 1.013)),
    "brisk": Orbit(58.9, 16.69, 0.007132, 0.8286, 0.4463, Lead(0.8698, 0.6595, 0.3447, 0.9669)),
    "quick": Orbit(60.43, 17.67, 0.01044, 0.9391, 0.555, Lead(0.8659, 0.9986, 0.448, 1.001)),
}
