"""Terrain: evaluation, training, tracking, model files, prediction."""
