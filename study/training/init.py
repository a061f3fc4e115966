"""The networks that a new run starts from."""

from pathlib import Path
from typing import Any

from ppo import checkpoint
from study.config import Config
from study.errors import InputError
from study.experiment import load_policy

FITTING = ("hidden", "log_std_bounds")  # keys of [ppo] without which the weights are another policy's


def networks_of(path: Path, config: Config) -> dict[str, dict[str, Any]]:
    """The weights of the policy and, where the file has them, of the value network.

    Args:
        path: policy.pt or checkpoint.pt of a run; config: of the run that is to start.

    Raises:
        CheckpointError, InputError: the file is none of these, or its networks are not those of the configuration.
    """
    _, trained = load_policy(path)
    for key in FITTING:
        theirs, ours = (list(getattr(each.ppo, key)) for each in (trained, config))
        if theirs != ours:
            raise InputError(
                f"--init-from {path}: its [ppo] {key} = {theirs}, not {ours} as in this run; set it with --config"
            )
    content = checkpoint.load(path, ("policy",))
    return {name: content[name] for name in ("policy", "value") if name in content}
