"""Intervals and tests: of one policy, and of two whose episodes are pairs."""
