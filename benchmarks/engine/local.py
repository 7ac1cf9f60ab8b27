"""Jobs in processes of this machine, one a core; or, to debug a method, in this one."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Set
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.queues import Queue
from queue import SimpleQueue

from deconfounded import envs
from deconfounded.benchmarks.console import escape_output
from deconfounded.benchmarks.engine import progress
from deconfounded.benchmarks.engine.scheduler import Engine, Some, run_job
from deconfounded.envs.physics import cores
from deconfounded.envs.support import outside


def die_with_parent() -> None:
    """End this process when the one that started it has ended, however that came about."""

    def wait() -> None:
        parent = multiprocessing.parent_process()
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def start_worker(ticks: "Queue[int]", folders: Set[str]) -> None:
    """Prepare a worker process: progress to `ticks`, Ctrl-C left to the main process; it dies with that.

    folders: those of plug-in files, which are on the import path that it has from there.
    """
    die_with_parent()
    outside.FOLDERS |= folders
    escape_output()
    progress.tell(ticks)


@contextmanager
def inherited() -> Iterator[None]:
    """Workers that are made meanwhile leave Ctrl-C alone, and have one thread: jobs beat threads within one."""
    heard, threads = signal.signal(signal.SIGINT, signal.SIG_IGN), os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, heard)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


class Local(Engine):
    """Processes that write their jobs' files themselves. They are made for the first jobs, and kept for those after.

    They have the code of when they were made, so that it is not to change while they are in use.
    """

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._ticks: Queue[int] = self._context.Queue()
        self._executor: ProcessPoolExecutor | None = None

    def __exit__(self, *error: object) -> None:
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
            self._executor = None

    def slots(self, device: str) -> int:
        return cores() if device == "cpu" else 1

    def run(self, jobs: list[Some], tick: Callable[[int], None], say: Callable[[Some, str | Exception], None]) -> None:
        if self._executor is None:
            arguments = self._ticks, {*outside.FOLDERS}
            self._executor = ProcessPoolExecutor(cores(), self._context, start_worker, arguments)
        with self._ended():
            self._pass_on(lambda late: None)  # of the jobs before
            with inherited():
                futures = {self._executor.submit(run_job, job): job for job in jobs}
            while futures:
                self._pass_on(tick)
                for future in [future for future in futures if future.done()]:
                    job = futures.pop(future)
                    try:
                        say(job, future.result())
                    except envs.InputError as error:
                        say(job, error)
                time.sleep(0.1)
        self._pass_on(tick)

    def _pass_on(self, tick: Callable[[int], None]) -> None:
        while not self._ticks.empty():
            tick(self._ticks.get())

    @contextmanager
    def _ended(self) -> Iterator[None]:
        """When the work ends early, by an error or a signal, none of its processes is left."""
        try:
            yield
        except BaseException as error:
            for process in multiprocessing.active_children():
                process.kill()
            self.__exit__()
            if isinstance(error, BrokenProcessPool):
                raise envs.InputError("a worker process was killed (out of memory?); run it again") from None
            raise


class Here(Engine):
    """This process, one job after another: for a debugger. What a job raises is raised here."""

    def __exit__(self, *error: object) -> None:
        pass

    def slots(self, device: str) -> int:
        return 1

    def run(self, jobs: list[Some], tick: Callable[[int], None], say: Callable[[Some, str | Exception], None]) -> None:
        ticks = SimpleQueue[int]()
        progress.tell(ticks)
        for job in jobs:
            say(job, job.run())
            while not ticks.empty():
                tick(ticks.get())
