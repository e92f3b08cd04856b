"""The devices and processes that the work is shared by."""

import contextlib
import dataclasses
import hashlib
import os
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree


@dataclasses.dataclass(frozen=True)
class Cores:
    """Where the work is done: all cores or accelerators of this machine."""

    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""

    def start(self) -> None:
        """Switch on float64 and take as many CPU devices as there are cores.

        Raises:
            ValueError: for devices that cannot be had.
        """
        jax.config.update("jax_enable_x64", True)
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        if self.devices is not None and self.devices < 1:
            raise ValueError(f"--devices {self.devices}: give at least one device.")
        try:
            jax.config.update("jax_num_cpu_devices", self.devices or cores)
        except RuntimeError:  # called from a program in which JAX is at work already: its devices are what there is
            present = jax.local_device_count()
            if self.devices not in (None, present):
                raise ValueError(
                    f"--devices {self.devices}: JAX already runs in this process, with {present}."
                ) from None


@dataclasses.dataclass(frozen=True)
class Devices(Cores):
    """Where the work is done: all cores or accelerators of this machine, alone or together with other processes."""

    distributed: bool = False
    """Share the runs with the other processes of this job, which SLURM, Open MPI or Kubernetes started; processes that
    are started by hand are given the next three options instead."""
    coordinator: str | None = None
    """HOST:PORT of process 0, the same for all processes."""
    num_processes: int | None = None
    """How many processes there are."""
    process_id: int | None = None
    """Number of this process, from 0."""

    def start(self) -> None:
        """Switch on float64, join the other processes, and take as many CPU devices as there are cores.

        Raises:
            ValueError: for devices or processes that cannot be had.
        """
        super().start()
        if self.distributed or self._is_by_hand():
            self._join()

    def _is_by_hand(self) -> bool:
        """Whether the processes are told here, each by itself."""
        given = (self.coordinator, self.num_processes, self.process_id)
        if given == (None, None, None):
            return False
        if self.coordinator is None or self.num_processes is None or self.process_id is None:
            raise ValueError("--coordinator, --num-processes and --process-id belong together: give all three.")
        host, _, port = self.coordinator.rpartition(":")
        if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
            raise ValueError(f"--coordinator {self.coordinator}: give HOST:PORT of process 0, the same to all.")
        if not 0 <= self.process_id < self.num_processes:
            raise ValueError(
                f"--process-id {self.process_id} of --num-processes {self.num_processes}: give numbers from 0 up, "
                "one to each process."
            )
        return True

    def _join(self) -> None:
        """Become one of several processes, by JAX's own means."""
        # A request to stop is to stop a process, not to be noted.
        jax.config.update("jax_enable_preemption_service", False)
        try:
            jax.distributed.initialize(
                self.coordinator,
                self.num_processes,
                self.process_id,
                # All end together (see `together`). Where one ends early, something went wrong: the others stop too.
                shutdown_timeout_seconds=60,
            )
        except (ValueError, TypeError, RuntimeError) as error:
            raise ValueError(
                f"processes cannot be joined: {error} Start them by SLURM, Open MPI or Kubernetes with --distributed, "
                "or give each --coordinator HOST:PORT, --num-processes and --process-id."
            ) from None
        with together():
            pass


def meet(devices: Sequence[jax.Device]) -> None:  # pyright: ignore[reportInvalidTypeForm] (jax.Device is untyped)
    """Let the processes of some devices connect, before work that takes them different times.

    To connect for the first time they have 30 s; once connected, one waits for another however long it takes.
    """
    if len({device.process_index for device in devices}) > 1:
        gather(spread(np.arange(len(devices)), Mesh(np.array(devices), ("lane",))))


@contextlib.contextmanager
def together() -> Iterator[list[Any]]:
    """A part of the work after which all processes go on, or none: what one is refused stops the others too.

    Gives a list for what must be the same in all of them; it is compared, as text, where the part ends, and who is
    there first waits. A single process does the part and no more.

    Raises:
        ValueError, OSError: this process's own, raised in the part; ValueError where another has one, or where they
            were given different things to do.
    """
    settings: list[Any] = []
    error = None
    try:
        yield settings
    except (ValueError, OSError) as refused:
        error = refused
    if jax.process_count() > 1:
        meet(jax.devices())
        digest = np.frombuffer(hashlib.sha256(repr(settings).encode()).digest(), np.uint8)
        is_fine, digests = multihost_utils.process_allgather((np.array(error is None), digest))
        if error is None and not np.all(is_fine):
            raise ValueError(f"process {int(np.argmin(is_fine))} was refused, so all stop; see what it says.")
        if error is None and np.any(digests != digests[0]):
            raise ValueError("the processes were given different options; give all the same.")
    if error is not None:
        raise error


def spread(lanes: PyTree[np.ndarray], mesh: Mesh) -> PyTree[Array]:
    """Arrays with lanes as leading axis, each device of a mesh with its part, whichever process it belongs to."""
    by_lane = NamedSharding(mesh, PartitionSpec("lane"))
    return jax.tree.map(
        lambda a: jax.make_array_from_callback(a.shape, by_lane, lambda part: a[part], dtype=a.dtype), lanes
    )


def gather(result: PyTree[Array]) -> PyTree[np.ndarray]:
    """Arrays of all devices on this host; the parts of other processes come from there."""
    if all(value.is_fully_addressable for value in jax.tree.leaves(result)):
        return jax.device_get(result)
    return multihost_utils.process_allgather(result, tiled=True)
