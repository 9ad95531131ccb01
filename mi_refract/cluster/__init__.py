"""Dask workers, on other machines or started here. Each worker is checked before it gets work.

In: the address of a Dask scheduler or a number of local processes, and the software and hardware that workers must
have. Out: a Dask client and its usable workers. A worker that differs is refused, with a message that names the worker
and the differences. Dask does the scheduling, the retries and the spilling. Importing this package does not import
Dask.
"""

__all__ = ["connection", "local_cluster", "on_worker", "workers"]
