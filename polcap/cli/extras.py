"""Modules that need an extra, or the command that installs it."""

from importlib import import_module
from typing import Any

from polcap.errors import SettingError


def training(module: str) -> Any:
    """A module of polcap.training. Raises SettingError where torch is not installed."""
    try:
        return import_module(f"polcap.training.{module}")
    except ModuleNotFoundError as error:
        raise SettingError(f"{error.name} is not installed; pip install 'polcap[train]'") from error
