"""The task for learners from elsewhere: importing this registers Inspection6DoF-v0 with Gymnasium."""

import gymnasium

gymnasium.register(
    "Inspection6DoF-v0",
    entry_point="interfaces.environment:Inspection6DoF",
    vector_entry_point="interfaces.vector:VectorInspection6DoF",
)
