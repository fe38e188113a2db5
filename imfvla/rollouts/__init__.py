"""A policy at work: its actor, evaluations in an environment or on held-out episodes, and what they write."""
