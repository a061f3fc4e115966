"""The flags of the C compiler that users have, those of most tests, which take less time, and those of long flights."""

from kernels import build

OPTIMISED = build.FLAGS
QUICK, LONG = (tuple(flag.replace("-O2", level) for flag in OPTIMISED) for level in ("-O0", "-O1"))
