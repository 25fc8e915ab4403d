"""Effects: named groups of parameters of the simulation that are 0 where the effect is absent."""
