"""The AgriMaRo thesis."""
