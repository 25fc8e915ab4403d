"""Figures of a cross-validation report."""
