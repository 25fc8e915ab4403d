"""One file a filter: its states, equations and noise, and what is concluded of a robot's motion by it."""
