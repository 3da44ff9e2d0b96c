"""The phases on disk: each function reads directories and writes one, for the verbs and the experiments alike."""
