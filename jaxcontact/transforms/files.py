"""Files that are written as a whole or not at all, and errors that say what to do instead."""

from __future__ import annotations

import contextlib
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
        OSError: if the path is a folder, its folder does not exist or cannot be written to, or the
            disk is full; one of the operating system's kinds, with a sentence that names the path.
    """
    return _atomic_write(Path(path).resolve(), mode)


def make_folder(path: Path) -> None:
    """Make a folder and those above it, as far as they are not there.

    Raises:
        OSError: if that cannot be, as of `atomic_write`.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _explained(error, f"cannot make the folder {path}") from error


def check_is_file(path: str | Path) -> None:
    """Check that there is something to read at a path.

    Raises:
        FileNotFoundError: if nothing is there.
        IsADirectoryError: if it is a folder.
    """
    place = Path(path)
    if place.is_dir():
        raise IsADirectoryError(f"{place} is a folder; name a file in it")
    if not place.exists():
        raise FileNotFoundError(
            f"there is no file {place}; check its name, and its folder {place.absolute().parent}"
        )


@contextmanager
def _atomic_write(path: Path, mode: str) -> Iterator[IO]:
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; name a file in it")
    encoding, newline = (None, None) if "b" in mode else ("utf-8", "")
    # Not tempfile: its files are private, and a result is as readable as any other file.
    part = path.with_name(f".{uuid.uuid4().hex}.part")
    try:
        if path.exists() and not path.is_file():
            with open(path, mode, encoding=encoding, newline=newline) as file:
                yield file
            return
        with open(part, mode.replace("w", "x"), encoding=encoding, newline=newline) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        raise _explained(error, f"cannot write {path}") from error
    finally:
        # Where nothing can be removed, that must not hide why nothing could be written.
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def _explained(error: OSError, failure: str) -> OSError:
    """Return an error of the same kind and number with a sentence."""
    explained = type(error)(
        f"{failure}: {error.strerror or error}; choose a place in a folder that exists, may be "
        "written to and has room"
    )
    explained.errno = error.errno
    return explained
