"""The plants: the plant that may differ from the model, and Basilisk."""
