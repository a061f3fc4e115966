"""Proximal policy optimisation over a leading seed axis: networks, advantage estimation and the learner."""
