"""How training ends badly. None of it needs PyTorch, so that whoever catches it need not wait for that."""


class CheckpointError(ValueError):
    """The file is missing, damaged or not a checkpoint of this program."""


class NonFiniteError(ArithmeticError):
    """A loss, statistic or gradient became NaN or infinite; the message names it, its seed and minibatch."""


class RankLostError(Exception):
    """Another rank ended while this one counted on it."""
