"""Studies that are no part of the package; ``python tests/studies NAME`` runs one."""
