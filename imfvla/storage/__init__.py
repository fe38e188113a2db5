"""Files on disk: what may be opened, and when a file counts as written."""
