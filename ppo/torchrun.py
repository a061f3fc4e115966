"""What torchrun tells a process that it started, in the environment: known at once, without PyTorch."""

import os


def is_launched() -> bool:
    """Whether torchrun started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def is_first() -> bool:
    """Whether this process is rank 0, without a meeting of the ranks."""
    return not is_launched() or os.environ["RANK"] == "0"


def local_rank() -> int:
    """The number of this process on its machine, from 0."""
    return int(os.environ.get("LOCAL_RANK", 0))
