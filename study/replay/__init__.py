"""The page that plays simulated episodes."""
