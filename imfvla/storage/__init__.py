"""Files on disk: bounded reading, whole-or-not-at-all writing, the run directory, what a result depends on."""
