"""The command ``terrain``, also as ``python -m terrain``."""

import sys
from importlib import import_module

from terrain import refuse_hidden_packages


def main() -> None:
    """Run the command line, unless a folder of the user's hides a package that it needs."""
    try:
        refuse_hidden_packages()
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    import_module("pipelines.cli.main").main()


if __name__ == "__main__":
    main()
