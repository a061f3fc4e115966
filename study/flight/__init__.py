"""Flying: evaluation, simulation, state files, offline filtering, and figures of episodes."""
