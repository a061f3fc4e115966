"""The C expressions of PyTorch's operations."""
