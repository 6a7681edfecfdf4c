"""A progress bar of the optimisation: iteration, value, gradient norm."""

from __future__ import annotations

from typing import Any


def progress_bar(total: int) -> Any:
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
