"""In: the name of a module that needs an extra. Out: the module, or what to install."""

from importlib import import_module
from typing import Any

from polcap.errors import SettingError


def training(module: str) -> Any:
    """A module of polcap.training; an error with the remedy where torch is not installed."""
    try:
        return import_module(f"polcap.training.{module}")
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[train]'") from error
