"""Objects whose parts depend on each other, so some attributes cannot change after construction."""

from typing import Any


class Fixed:
    """Refuses to change the attributes in FIXED, since parts made from their first values would not follow.

    Raises:
        AttributeError: such an attribute is set again, or deleted.
    """

    FIXED: tuple[str, ...] = ()

    def __setattr__(self, name: str, value: Any) -> None:
        self._refuse_change(name)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        self._refuse_change(name)
        super().__delattr__(name)

    def _refuse_change(self, name: str) -> None:
        if name in self.FIXED and name in vars(self):
            kind = type(self).__name__
            raise AttributeError(
                f"{kind}.{name} cannot be changed: other parts were made from it; make a new {kind}"
            )
