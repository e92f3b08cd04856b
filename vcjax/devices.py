"""The devices and processes that a command works with."""

import dataclasses
import os

import jax


@dataclasses.dataclass(frozen=True)
class Devices:
    """Where the work is done: all cores or accelerators of this machine, alone or together with other processes."""

    devices: int | None = None
    """CPU devices to share the runs; all cores if not given."""
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
        jax.config.update("jax_enable_x64", True)
        self._take_cores()
        if self.distributed or self._is_by_hand():
            self._join()

    def _is_by_hand(self) -> bool:
        """Whether the processes are told here, each by itself."""
        given = (self.coordinator, self.num_processes, self.process_id)
        if given == (None, None, None):
            return False
        if self.coordinator is None or self.num_processes is None or self.process_id is None:
            raise ValueError("--coordinator, --num-processes and --process-id belong together: give all three.")
        if not self.coordinator.rpartition(":")[2].isdecimal():
            raise ValueError(f"--coordinator {self.coordinator}: give HOST:PORT of process 0, the same to all.")
        if not 0 <= self.process_id < self.num_processes:
            raise ValueError(
                f"--process-id {self.process_id} of --num-processes {self.num_processes}: give numbers from 0 up, "
                "one to each process."
            )
        return True

    def _take_cores(self) -> None:
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

    def _join(self) -> None:
        """Become one of several processes, by JAX's own means."""
        try:
            jax.distributed.initialize(
                self.coordinator,
                self.num_processes,
                self.process_id,
                # Who is done first waits at its end for the others, however long they take; who dies is found out by
                # its missing heartbeat.
                shutdown_timeout_seconds=7 * 24 * 3600,
            )
        except (ValueError, TypeError, RuntimeError) as error:
            raise ValueError(
                f"--distributed: {error} Start the processes by SLURM, Open MPI or Kubernetes, or give --coordinator "
                "HOST:PORT, --num-processes and --process-id."
            ) from None
