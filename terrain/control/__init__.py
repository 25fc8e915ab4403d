"""From a terrain to the slip to aim for."""
