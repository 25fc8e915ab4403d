"""Writing files whole or not at all, packaged data, and reading JSON, YAML and names of strangers."""
