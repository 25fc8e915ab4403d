"""What a simulation gets wrong about measured runs: shown, named, built in, and the gain measured."""
