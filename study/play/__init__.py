"""The page on which anybody flies the deputy, with the filter on or off."""
