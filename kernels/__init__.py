"""Functions of a batch made fast: recorded, printed as C, built and loaded. It knows nothing of spacecraft."""
