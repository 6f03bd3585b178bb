"""Trials on a cluster: Dask's scheduler and workers, wherever they are."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from diransac.errors import SettingsError, StudyError

__all__ = ["connected"]

_PATIENCE = "10s"


@contextmanager
def connected(address: str) -> Iterator[tuple[Executor, int]]:
    """An executor on the cluster whose scheduler listens there, and how many tasks keep its workers busy.

    Parameters
    ----------
    address : such as ``tcp://host:8786``

    Raises SettingsError: Dask is not installed.  StudyError: nobody listens there, or no more.
    """
    try:
        from distributed.client import Client, ClosedClientError
    except ModuleNotFoundError as error:
        raise SettingsError("a cluster needs Dask, which is not installed; pip install 'diransac[cluster]'") from error
    try:
        client = Client(address, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(f"no scheduler at {address}: {error}; start one with dask scheduler") from error
    with client:
        try:
            yield client.get_executor(), 2 * max(32, sum(client.nthreads().values()))
        except ClosedClientError as error:
            raise StudyError(
                f"the scheduler at {address} is gone; all that is done is kept: start another, then run it again"
            ) from error
