"""The machine: compiling, threads, device, progress, one process to a directory, and what describes it all."""
