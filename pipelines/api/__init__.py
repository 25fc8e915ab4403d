"""The Python API that ``import terrain`` gives lazily."""
