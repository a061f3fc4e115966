"""Monte Carlo campaigns: how often, and how badly, any constraint is violated behind the filter."""
