"""The operating system: worker processes, signals, progress on a terminal, the GL backend."""
