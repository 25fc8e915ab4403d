"""What a simulation gets wrong about measured runs: found, named, built in, and the gain measured."""
