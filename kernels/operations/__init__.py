"""What each operation of PyTorch is in C."""
