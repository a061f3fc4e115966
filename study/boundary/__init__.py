"""Single calls next to the limits."""
