"""Loading moved to :mod:`pipelines.learn.model_file`."""

from pipelines.learn.load import load_model

__all__ = ["load_model"]
