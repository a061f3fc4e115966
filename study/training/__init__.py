"""Training: one run on disk, and the study of many."""
