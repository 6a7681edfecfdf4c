"""Files that are written as a whole or not at all."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import IO, Literal, overload


@overload
def atomic_write(path: str | Path, mode: Literal["wb"]) -> AbstractContextManager[IO[bytes]]: ...


@overload
def atomic_write(path: str | Path, mode: Literal["w"]) -> AbstractContextManager[IO[str]]: ...


def atomic_write(
    path: str | Path, mode: Literal["w", "wb"]
) -> AbstractContextManager[IO[str]] | AbstractContextManager[IO[bytes]]:
    """Open a file for writing that takes its place only when it is complete.

    What is written goes to a new file in the same folder. At the end of the `with` block it
    replaces the old one; after an exception, a kill or on a full disk the old one is still there.

    Args:
        path: the file; a link is followed, and a device is written to directly.
        mode: "wb" for bytes; "w" for text in UTF-8, with line ends as they are written.

    Raises:
        OSError: if the folder does not exist or cannot be written to.
    """
    return _atomic_write(Path(path).resolve(), mode)


@contextmanager
def _atomic_write(path: Path, mode: str) -> Iterator[IO]:
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    if path.exists() and not path.is_file():
        with open(path, mode, encoding=encoding, newline=newline) as file:
            yield file
        return
    # Not tempfile: its files are private, and a result is as readable as any other file.
    part = path.with_name(f".{uuid.uuid4().hex}.part")
    try:
        with open(part, mode.replace("w", "x"), encoding=encoding, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
