"""Tracking moved to :mod:`pipelines.learn.tracking`, loading to :mod:`pipelines.learn.model_file`."""

from pipelines.learn.load import load_model
from pipelines.learn.tracking import code_commit, ensure_tracking, log_learning

__all__ = ["code_commit", "ensure_tracking", "load_model", "log_learning"]
