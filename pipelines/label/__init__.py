"""Labels of recorded runs: windows that the model was in doubt about, and the terrain that a person gives."""
