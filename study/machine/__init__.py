"""The machine: threads and progress."""
