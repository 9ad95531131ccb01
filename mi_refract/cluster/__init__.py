"""Workers on other machines, through Dask: connected to, checked before they get work, or started here.

In: the address of a Dask scheduler or a number of local processes, and what workers must have. Out: a Dask client, and
which of the workers may have work; a worker that differs is refused by name, with what differs. Scheduling,
retries and spilling are Dask's. Importing this room does not import Dask.
"""

__all__ = ["connection", "local_cluster", "on_worker", "workers"]
