"""Models moved to :mod:`pipelines.learn.model_file`."""

from pipelines.learn.model_file import MODEL_FILE, ModelInfo, TerrainModel, read_model, write_model

__all__ = ["MODEL_FILE", "ModelInfo", "TerrainModel", "read_model", "write_model"]
