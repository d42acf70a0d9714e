"""Figures are shown in words."""

from polcap.report import labels


def test_an_empty_list_is_shown_as_none() -> None:
    assert labels.text("chart.unused", []) == labels.text("chart.unused", {}) == "none"
    assert labels.text("chart.unused", [1, 2]) == "1, 2"
