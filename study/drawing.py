"""What figures are drawn with. They are written to files, so that no backend is needed, whatever MPLBACKEND names."""

import os
import sys
from contextlib import suppress

named = None if "matplotlib" in sys.modules else os.environ.pop("MPLBACKEND", None)
import matplotlib  # which fails where that is not installed, as in a shell below Jupyter

if named is not None:
    os.environ["MPLBACKEND"] = named
    with suppress(ValueError):
        matplotlib.rcParams["backend"] = named  # of whoever imports this and shows figures of their own

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, MultipleLocator, NullFormatter, StrMethodFormatter
from mpl_toolkits.mplot3d import Axes3D

__all__ = [
    "Axes",
    "Axes3D",
    "Figure",
    "Line2D",
    "MaxNLocator",
    "MultipleLocator",
    "NullFormatter",
    "Rectangle",
    "StrMethodFormatter",
    "matplotlib",
    "rc_context",
    "withStroke",
]
