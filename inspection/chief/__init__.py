"""The chief: its points, its shape, and how it tumbles."""
