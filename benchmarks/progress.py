"""A progress bar for long work."""

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

_log = logging.getLogger(__name__)


@contextmanager
def progress(total: int, unit: str = "step") -> Iterator[Callable[[], object]]:
    """A progress bar on a terminal, if there is one and tqdm is installed."""
    bar: Any = None
    try:
        from tqdm import tqdm
    except ImportError:
        _log.debug("tqdm is not installed: no progress bar")
    else:
        bar = tqdm(total=total, unit=unit, disable=None)
    try:
        yield (lambda: None) if bar is None else bar.update
    finally:
        if bar is not None:
            bar.close()
