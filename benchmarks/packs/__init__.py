"""SoC errors on recorded packs, with models from few logs: see `python -m packs --help`."""
