"""The backup laws, which keep every limit and end where the spacecraft can stay, and the checks of their flight."""
