"""Fast functions of a batch: recorded, printed as C, built and loaded. This package knows nothing of spacecraft."""
