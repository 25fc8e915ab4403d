"""Plants: what a robot does on its ground, in two fidelities of wheels, on tracks, and as a car."""
