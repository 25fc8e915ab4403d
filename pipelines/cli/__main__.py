"""``python -m pipelines.cli`` is ``terrain``."""

from pipelines.cli.main import main

main()
