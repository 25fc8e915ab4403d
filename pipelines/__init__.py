"""Commands: read, call pure code, write.  Files, tracking and screens live here."""
