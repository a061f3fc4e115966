"""Experiments: configuration, training runs, evaluation, tables and figures of the paper's Results section.

`load_policy(path)` is a trained `Policy` and the `Config` it was trained in, `load_config(path)` that of a TOML file,
and an `Experiment` has what a configuration determines: device, filter, environments. What is wrong with a file is
an `InputError`, which says so in a line.
"""

from typing import TYPE_CHECKING

from on_demand import on_demand

if TYPE_CHECKING:
    from study.config import Config
    from study.config import load as load_config
    from study.errors import InputError
    from study.experiment import Experiment, load_policy

__all__ = ["Config", "Experiment", "InputError", "load_config", "load_policy"]

__getattr__ = on_demand(
    __name__,
    {
        "Config": "study.config.Config",
        "load_config": "study.config.load",
        "InputError": "study.errors.InputError",
        "Experiment": "study.experiment.Experiment",
        "load_policy": "study.experiment.load_policy",
    },
)
