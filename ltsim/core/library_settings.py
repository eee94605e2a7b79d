"""Imports of libraries without their settings file in the working folder, which may be somebody else's.

Matplotlib reads a file `matplotlibrc` when it is imported, and Numba a file `.numba_config.yaml` at every compilation.
Such a file could run code (matplotlib before 3.11, and the folder of machine code that Numba loads), keep the program
waiting (a pipe), or end it with an internal error. Settings in the user's home folder and environment still apply.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory


@contextmanager
def without_settings_file(file_name: str) -> Iterator[bool]:
    """Context in which the working folder has no file `file_name`; it yields True if there was such a file before.

    If there was, the working folder is an empty temporary folder meanwhile, for all threads of this process.
    """
    is_present = os.path.lexists(file_name)
    if not is_present:
        yield False
        return
    working_folder = Path.cwd()
    with TemporaryDirectory(prefix="ltsim-") as empty_folder:
        os.chdir(empty_folder)
        try:
            yield True
        finally:
            os.chdir(working_folder)
