"""Eight terrains by stiffness on simulated runs, by the protocol of the AgriMaRo thesis."""
