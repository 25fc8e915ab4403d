"""The Python API that ``import terrain`` offers lazily: the same functions as the commands, on objects."""
