"""A progress bar of the optimisation: iteration, value, gradient norm."""

from __future__ import annotations

from typing import Protocol


class ProgressBar(Protocol):
    """What is used of a tqdm bar."""

    def set_postfix_str(self, s: str, refresh: bool) -> None:
        """Set the text behind the bar."""
        ...

    def update(self, n: int) -> object:
        """Move the bar on."""
        ...

    def close(self) -> None:
        """End the bar."""
        ...


def progress_bar(total: int) -> ProgressBar:
    """Return a tqdm bar.

    Raises:
        ImportError: if the extra `progress` is not installed.
    """
    try:
        from tqdm.auto import tqdm
    except ImportError as error:
        raise ImportError(
            "progress=True needs tqdm; install it with pip install 'jaxcontact[progress]'"
        ) from error
    return tqdm(total=total, unit="it", desc="optimize")
