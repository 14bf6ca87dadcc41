"""Workers of a Dask cluster for a batch of replays.

Dask runs whatever program anybody sends to its scheduler, with the rights of its workers: a scheduler without
certificates must be reachable by nobody else. Files are opened by the workers, so all of them need the same folders.
"""

import contextlib
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otolith.runtime.batch.task import ReplayOutcome, ReplayTask, libraries, perform_task
from otolith_drivers.errors import ConfigurationError, ServiceError, installation_of

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
CONNECT_TIMEOUT = 10.0  # s
POLL = 0.5  # s between two looks at the tasks, if none of them ends
TASKS_PER_WORKER = 2  # the second one waits there, so that the worker is never idle
THREADS = "OPENBLAS_NUM_THREADS"


@dataclass(frozen=True, slots=True)
class ClusterAccess:
    """Where a scheduler is, and with which certificates it is reached."""

    address: str
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    def __post_init__(self) -> None:
        """Raise ConfigurationError for an address that cannot be, or does not fit the certificates."""
        given = [self.ca, self.certificate, self.key]
        kind, _, rest = self.address.partition("://")
        if kind not in ("tcp", "tls") or not rest:
            raise ConfigurationError(f"--scheduler {self.address}: write it like tcp://10.0.0.5:8786 or tls://…")
        if (kind == "tls") != all(given) or (kind == "tcp" and any(given)):
            raise ConfigurationError(
                f"--scheduler {self.address}: tls:// needs --ca, --certificate and --key, and only that"
            )


@contextlib.contextmanager
def cluster_workers(access: ClusterAccess) -> Iterator["ClusterWorkers"]:
    """Yield the workers of a cluster.

    Raises:
        ConfigurationError: ``distributed`` is missing, or a certificate is wrong.
        ServiceError: the scheduler does not answer, has no worker, or is lost.
    """
    try:
        from distributed import Client, Security  # noqa: PLC0415 - of the extra
    except ImportError as error:
        fault = f"a cluster needs the extra 'cluster': {installation_of('cluster')} ({error})"
        raise ConfigurationError(fault) from error
    security = None
    if access.ca is not None:
        security = Security(  # type: ignore[no-untyped-call]
            tls_ca_file=str(access.ca),
            tls_client_cert=str(access.certificate),
            tls_client_key=str(access.key),
            require_encryption=True,
        )
    try:
        client: Any = Client(access.address, security=security, timeout=CONNECT_TIMEOUT, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise ServiceError(f"scheduler {access.address}: {error or 'no answer'}") from error
    with client:
        workers = ClusterWorkers(client, access.address)
        workers.require_same_versions()
        try:
            yield workers
        finally:
            workers.close()


class ClusterWorkers:
    """The tasks of a batch on a cluster."""

    def __init__(self, client: Any, address: str) -> None:
        self._client, self._address = client, address
        self._futures: dict[str, Any] = {}  # By the key of the task

    @property
    def room(self) -> int:
        """Number of tasks that can be submitted now."""
        workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
        return max(0, TASKS_PER_WORKER * max(workers, 1) - len(self._futures))

    def submit(self, key: str, task: ReplayTask) -> None:
        """Let a worker compute a task; the scheduler gives it to another one if that worker ends."""
        self._futures[key] = self._client.submit(perform_task, task, pure=False)

    def finished(self) -> list[tuple[str, ReplayOutcome | None, str]]:
        """Wait for a moment, and return what was finished: key, outcome, and why there is none."""
        from distributed import wait  # noqa: PLC0415 - of the extra

        with self._client.as_current(), contextlib.suppress(TimeoutError):
            wait(list(self._futures.values()), timeout=POLL, return_when="FIRST_COMPLETED")  # type: ignore[no-untyped-call]
        if self._client.status not in ("running", "connecting"):
            raise ServiceError(f"scheduler {self._address}: the connection is lost: start again to continue")
        done = list[tuple[str, ReplayOutcome | None, str]]()
        for key, future in list(self._futures.items()):
            if future.status == "pending":
                continue
            del self._futures[key]
            if future.status == "finished":
                done.append((key, future.result(), ""))
            else:
                error = future.exception() if future.status == "error" else None
                done.append((key, None, f"{error or f'its task is {future.status}'}"))
        return done

    def close(self) -> None:
        """Let all tasks go."""
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self._client.cancel(list(self._futures.values()), force=True)
        self._futures.clear()

    def require_same_versions(self) -> None:
        """Raise ServiceError if there is no worker, or reports of a worker may differ from those of this computer."""
        own, found = libraries(), dict[str, Mapping[str, str]](self._client.run(libraries))
        if not found:
            raise ServiceError(f"scheduler {self._address}: it has no worker: start some with 'dask worker'")
        for worker, versions in found.items():
            if versions[THREADS] != "1":
                remedy = f"start it with {THREADS}=1, or with its nanny, which sets it"
                raise ServiceError(
                    f"worker {worker}: {THREADS} is {versions[THREADS]!r}, so rounding may differ: {remedy}"
                )
            if other := [
                name for name in own if name not in (THREADS, "processor") and versions.get(name) != own[name]
            ]:
                pairs = ", ".join(f"{name} {versions.get(name)} instead of {own[name]}" for name in other)
                raise ServiceError(f"worker {worker}: {pairs}: install the same versions there")
        if len(kinds := {versions["processor"] for versions in found.values()}) > 1:
            log.warning(
                "workers have several kinds of processors, which may round the last bit in other ways: %s", kinds
            )
