"""Terrain classifiers as scikit-learn estimators on feature vectors."""
