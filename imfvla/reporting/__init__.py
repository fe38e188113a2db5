"""From run directories to tables. Reads files only: neither torch nor mujoco is imported here."""
