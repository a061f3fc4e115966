"""Experiments: configuration, training runs, evaluation, tables and figures of the paper's Results section."""
