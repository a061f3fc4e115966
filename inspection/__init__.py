"""The task: a deputy spacecraft inspects a passive chief, thousands of episodes as one batch of tensors."""
