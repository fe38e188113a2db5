"""Faults of tools/chaos.py: each injects one into real processes and compares the result with an undisturbed run."""
