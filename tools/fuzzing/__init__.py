"""What `tools/fuzz.py` damages, how, and who reads it."""
