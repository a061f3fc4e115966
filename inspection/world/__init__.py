"""The worlds that are flown in: the plant, which may differ from the model, and Basilisk."""
