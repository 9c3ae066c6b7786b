"""`python -m cangauge`: the command line."""

from cangauge.cli.app import main

main()
