"""Say why the very first run takes longer."""

from __future__ import annotations

from pathlib import Path

from valveflow_ros.core import segmenter_kernel

SENTENCE = 'The engine is compiled for this machine now, once; that takes about a minute.'


def is_first_run() -> bool:
    """Tell whether the compiled engine is not in numba's cache yet.

    False as well where nothing is compiled or nothing can be told.
    """
    statistics = getattr(segmenter_kernel.run, 'stats', None)
    path = getattr(statistics, 'cache_path', None)
    return path is not None and not any(Path(path).glob('*.nbi'))
