"""Recipes, model files and tracking."""
