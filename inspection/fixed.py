"""Objects whose parts depend on each other, so that some attributes are fixed once they are made."""

from typing import Any


class Fixed:
    """Refuses another value of the attributes in FIXED: what was made from the first one would not follow.

    Raises:
        AttributeError: such an attribute is set again.
    """

    FIXED: tuple[str, ...] = ()

    def __setattr__(self, name: str, value: Any) -> None:
        if name in self.FIXED and name in vars(self):
            kind = type(self).__name__
            raise AttributeError(
                f"{kind}.{name} is fixed, since the rest of it was made from it: make another {kind}"
            )
        super().__setattr__(name, value)
