"""Files that are either as they were or complete, whatever happens."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

#: How the name of a file ends that is being written.
PARTIAL = ".partial"


@contextmanager
def replaced(path: Path) -> Iterator[BinaryIO]:
    """Write a file beside its place; it comes there when it is whole and on the disk.

    :param path: the file; its folder need not be there yet
    :raises OSError: if it cannot be written; an old file of that name is then untouched
    """
    path = path.resolve()  # of a link, what it points to
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}{PARTIAL}")
    try:
        with partial.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_text(path: Path, text: str) -> None:
    """Write a text file in one piece.

    :param path: the file
    :param text: what it is to hold
    """
    with replaced(path) as file:
        file.write(text.encode())


def sync_folder(folder: Path) -> None:
    """See that the names in a folder survive a power failure.

    :param folder: the folder
    """
    if os.name == "nt":  # where folders cannot be opened
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
