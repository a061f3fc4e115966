"""The command line: flags, what they reach, and which files they may name."""
