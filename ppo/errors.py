"""Errors that end a training. They do not need PyTorch, so that code that catches them does not wait for its import."""


class CheckpointError(ValueError):
    """Signals that the file is missing, damaged or not a checkpoint of this program."""


class NonFiniteError(ArithmeticError):
    """Signals that a loss, statistic or gradient became NaN or infinite; names it, its seed and minibatch."""


class RankLostError(Exception):
    """Signals that another rank ended while this one waited for it."""
