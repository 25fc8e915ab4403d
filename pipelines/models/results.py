"""What is known of a model moved to :mod:`pipelines.learn.model_file`."""

from pipelines.learn.model_file import ModelInfo

__all__ = ["ModelInfo"]
