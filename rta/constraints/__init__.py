"""The limits, one entry each."""
