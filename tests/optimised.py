"""The flags of the C compiler that users have, and those of most tests, which take less time."""

from kernels import build

OPTIMISED = build.FLAGS
QUICK = tuple(flag.replace("-O2", "-O0") for flag in OPTIMISED)
