"""A fresh process whose linear algebra keeps to one thread.

With more threads than idle cores, a dense solver can wait twenty times longer for its threads than
it computes: the same solve took 0.5 s with one thread and 12.7 s with two. The number of threads
is read when the libraries are loaded, so it takes a new process to change it.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import ParamSpec, TypeVar

_VARIABLES = (
    "MKL_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def in_one_thread(
    task: Callable[Arguments, Result], *arguments: Arguments.args, **named: Arguments.kwargs
) -> Result:
    """Run a module's function in a process of its own and return, or raise, what it does."""
    with one_thread_each(1) as pool:
        return pool.submit(task, *arguments, **named).result()


@contextmanager
def one_thread_each(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of new processes, each of which keeps to one thread."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    os.environ.update(dict.fromkeys(_VARIABLES, "1"))
    try:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            yield pool
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
