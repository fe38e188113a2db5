"""Faults of tools/chaos.py: each puts one into real processes and compares what is left with an undisturbed run."""
