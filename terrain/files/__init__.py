"""Writing files whole or not at all, packaged data, and reading YAML descriptions."""
