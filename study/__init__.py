"""Experiments: configuration, training runs, evaluation, tables and figures of the paper's Results section.

`load_policy(path)` is a trained `Policy` and the `Config` it was trained in, `load_config(path)` that of a TOML file,
and an `Experiment` has what a configuration determines: device, filter, environments. What is wrong with a file is
an `InputError`, which says so in a line.
"""

from study.config import Config
from study.config import load as load_config
from study.errors import InputError
from study.experiment import Experiment, load_policy

__all__ = ["Config", "Experiment", "InputError", "load_config", "load_policy"]
