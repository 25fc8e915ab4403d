"""Where independent tasks are computed: on this machine's cores, or on the workers of a Dask scheduler."""
