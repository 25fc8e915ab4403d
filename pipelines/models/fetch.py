"""Copy a registered model: ``python -m pipelines.models.fetch URI FOLDER`` prints where it is then."""

from __future__ import annotations

import sys

from terrain.errors import TerrainError


def main(uri: str, folder: str) -> int:
    """Print the folder of the model's copy; a failure is one sentence and exit code 2."""
    from pipelines.models.tracking import fetch_model

    try:
        print(fetch_model(uri, folder))
    except TerrainError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:3]))
