"""Engines of a sweep: processes of this machine, or a dask cluster.

An engine has three calls and a number of workers, each of which does one task at a time:

    submit(call, *arguments) -> handle      done(handles) -> handles that ended, after a wait for one
    result(handle) -> value of the call     WorkerLost if its worker died; reset() forgets other calls, if there is one
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Protocol

from ..base.devices import find_device
from ..base.errors import Error, ModelError

__all__ = ["DaskEngine", "Engine", "PoolEngine", "WorkerLost", "make_engine"]


class WorkerLost(Exception):
    """The worker of a task died."""


class Engine(Protocol):
    """Workers that do the tasks of a sweep.

    Attributes:
        workers: number of tasks at a time.
    """

    workers: int

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Start a call; returns its handle."""

    def done(self, handles: Collection[Any]) -> Collection[Any]:
        """Those of the handles whose calls ended; waits for one."""

    def result(self, handle: Any) -> Any:
        """Value of an ended call. Raises its error, or WorkerLost."""

    def close(self) -> None:
        """End, with calls that are left."""


class PoolEngine:
    """One spawned process per worker, replaced when it dies.

    Args:
        workers: number of processes; None: one per GPU, or per core.
        gpus: indices of GPUs, over which the workers are dealt out, each seeing one alone; none: the CPU.
        memory: limit of a process's address space, bytes; None: no limit. For the CPU: CUDA reserves addresses.

    Attributes:
        pids: of the processes. gpus: as given.
    """

    def __init__(self, workers: int | None = None, *, gpus: Sequence[int] = (), memory: float | None = None) -> None:
        if getattr(multiprocessing.current_process(), "_inheriting", False):
            raise ModelError('a sweep starts processes that import this file: put it under if __name__ == "__main__":')
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self.workers, self.memory, self.gpus = workers or len(gpus) or cores, memory, tuple(gpus)
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",")
        names = [visible[gpu] if gpu < len(visible) and visible[gpu] else str(gpu) for gpu in gpus]
        self.environments = [_environment(names[k % len(names)] if names else None) for k in range(self.workers)]
        self.busy: dict[Future[Any], int] = {}
        self.pids = [0] * self.workers
        self.executors: list[ProcessPoolExecutor] = []
        started = [self._start(k) for k in range(self.workers)]
        self.executors = [executor for executor, _ in started]
        try:
            self.pids = [future.result() for _, future in started]
        except BrokenProcessPool as error:
            raise ModelError(
                "a worker process can't start (its error is above); a script that sweeps needs "
                'if __name__ == "__main__": before what it does'
            ) from error

    def _start(self, k: int) -> tuple[ProcessPoolExecutor, Future[int]]:
        context = multiprocessing.get_context("spawn")
        executor = ProcessPoolExecutor(1, mp_context=context, initializer=_begin_worker, initargs=(self.memory,))
        with _changed_environment(self.environments[k]):
            return executor, executor.submit(os.getpid)  # the process starts here

    def _replace(self, k: int) -> None:
        self.executors[k].shutdown()
        self.executors[k], future = self._start(k)
        with contextlib.suppress(BrokenProcessPool):  # then its next task is lost
            self.pids[k] = future.result()

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start a call in an idle process."""
        k = min(set(range(self.workers)) - set(self.busy.values()))
        try:
            future = self.executors[k].submit(call, *arguments)
        except BrokenProcessPool:  # it died idle
            self._replace(k)
            future = self.executors[k].submit(call, *arguments)
        self.busy[future] = k
        return future

    def done(self, handles: Collection[Future[Any]]) -> Collection[Future[Any]]:
        """Calls that ended; waits for one."""
        return wait(handles, return_when=FIRST_COMPLETED).done

    def result(self, handle: Future[Any]) -> Any:
        """Value of an ended call. WorkerLost; errors that are not warpfea's end the process."""
        k = self.busy.pop(handle)
        try:
            return handle.result()
        except Error:
            raise
        except BrokenProcessPool as error:
            self._replace(k)
            raise WorkerLost(str(error)) from error
        except Exception:
            self._replace(k)
            raise

    def reset(self) -> None:
        """Leave the calls whose values were not asked for."""
        self._terminate()
        for k in set(self.busy.values()):
            self._replace(k)
        self.busy.clear()

    def _terminate(self) -> None:
        """End the processes at work."""
        pids = {self.pids[k] for k in self.busy.values()}
        for process in multiprocessing.active_children():
            if process.pid in pids:
                process.terminate()

    def close(self) -> None:
        """End the processes, at once if they are at work."""
        self._terminate()
        for executor in self.executors:
            executor.shutdown(cancel_futures=True)


def _environment(gpu: str | None) -> dict[str, str]:
    """Environment of a worker: its GPU, and one thread of BLAS."""
    return {"CUDA_VISIBLE_DEVICES": gpu or "", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@contextlib.contextmanager
def _changed_environment(values: Mapping[str, str]) -> Iterator[None]:
    """Environment variables, which processes that start within inherit."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_worker(memory: float | None) -> None:
    """Start Warp, limit the memory, and end with the parent, also if that is killed."""
    find_device("cpu")
    if memory is not None:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    parent = multiprocessing.parent_process()

    def follow() -> None:
        assert parent is not None
        parent.join()
        os._exit(1)

    if parent is not None:
        threading.Thread(target=follow, daemon=True).start()


class DaskEngine:
    """Workers of a dask.distributed scheduler, one thread each; one per GPU, each with the resource GPU=1.

    Its messages are pickles, which run code: only on a trusted network. Files of scenes and designs must have the same
    paths on all machines.

    Args:
        scheduler: address such as "tcp://host:8786", or a dask Client.
        gpu: tasks need a GPU.

    Raises:
        ModelError: dask.distributed is not installed, no worker, or one with several threads.
    """

    def __init__(self, scheduler: Any, *, gpu: bool = False) -> None:
        try:
            import distributed
        except ImportError as error:
            raise ModelError(f"a scheduler needs dask: pip install 'warpfea[cluster]' ({error})") from error
        self.distributed, self.own = distributed, isinstance(scheduler, str)
        try:
            self.client = distributed.Client(scheduler, set_as_default=False) if self.own else scheduler
            self.client.wait_for_workers(1, timeout=60)
        except (OSError, TimeoutError) as error:
            raise ModelError(f"no scheduler with workers at {scheduler!r}: {error}") from error
        self.resources = {"GPU": 1} if gpu else None
        threads = self.client.nthreads()
        for address, count in threads.items():
            if count != 1:
                raise ModelError(f"the dask worker {address} has {count} threads: start it with --nthreads 1")
        self.workers = len(threads)

        self.allowed = self.client.run_on_scheduler(_set_allowed_failures, count=0)  # we count them ourselves

    def submit(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Start a call on some worker."""
        return self.client.submit(_call_with_address, call, *arguments, pure=False, retries=0, resources=self.resources)

    def done(self, handles: Collection[Any]) -> Collection[Any]:
        """Calls that ended; waits for one."""
        with self.client.as_current():
            return self.distributed.wait(list(handles), return_when="FIRST_COMPLETED").done

    def result(self, handle: Any) -> Any:
        """Value of an ended call. WorkerLost; errors that are not warpfea's end the worker, as those of CUDA stay."""
        try:
            return handle.result()
        except Error:
            raise
        except self.distributed.KilledWorker as error:
            raise WorkerLost(str(error)) from error
        except Exception as error:
            if address := vars(error).get("worker"):
                self._replace(address)
            raise

    def _replace(self, address: str) -> None:
        """End a worker, which its nanny starts again, if it has one."""
        try:
            self.client.restart_workers([address], timeout=60, raise_for_error=False)
        except ValueError:  # no nanny
            self.client.run(os._exit, 1, workers=[address], on_error="ignore")

    def close(self) -> None:
        """Leave the scheduler as it was."""
        with contextlib.suppress(OSError, TimeoutError, ValueError):  # of a scheduler that is gone
            self.client.run_on_scheduler(_set_allowed_failures, count=self.allowed)
        if self.own:
            self.client.close()


def _call_with_address(call: Callable[..., Any], *arguments: Any) -> Any:
    """Value of a call; its errors carry the address of the worker."""
    try:
        return call(*arguments)
    except Exception as error:
        import distributed

        vars(error)["worker"] = distributed.get_worker().address
        raise


def _set_allowed_failures(count: int, dask_scheduler: Any = None) -> int:
    """Set deaths of workers after which a scheduler gives up a task; returns those before."""
    before, dask_scheduler.allowed_failures = dask_scheduler.allowed_failures, count
    return int(before)


def make_engine(given: Any, device: str, memory: float | None = None) -> Engine:
    """An engine from a number of workers, the address of a scheduler, an engine, or None for all of this machine.

    Args:
        device: "cpu", "cuda" for all GPUs, or one of them.

    Raises:
        ModelError: none of these.
    """
    gpu = device.startswith("cuda")
    if isinstance(given, str):
        return DaskEngine(given, gpu=gpu)
    if given is None or (isinstance(given, int) and not isinstance(given, bool) and given > 0):
        return PoolEngine(given, gpus=_gpus(device) if gpu else (), memory=memory)
    if all(hasattr(given, name) for name in ("submit", "done", "result", "workers")):
        return given
    raise ModelError(f"engine = {given!r} must be a number of workers, 'tcp://host:port' or an engine")


def _gpus(device: str) -> list[int]:
    """Indices of the GPUs of "cuda" or "cuda:1"."""
    import warp as wp

    number = device.partition(":")[2]
    return [int(number)] if number else list(range(wp.get_cuda_device_count()))
