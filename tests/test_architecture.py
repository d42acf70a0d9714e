"""The house stands as the architecture page draws it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_layers_and_strangers() -> None:
    pytest.importorskip("importlinter")
    done = subprocess.run(
        [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stdout


def test_stages_stand_in_the_order_of_the_path() -> None:
    from polcap import stages
    from polcap.path import STAGES

    listed = re.findall(r"^    (\w+)  ", stages.__doc__ or "", re.M)
    assert tuple(listed) == STAGES


def test_settings_page_is_the_generated_one() -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "docs" / "make_settings.py")],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert done.stdout == (ROOT / "docs" / "reference" / "settings.md").read_text(encoding="utf-8"), done.stderr


@pytest.mark.parametrize("page", [*sorted(ROOT.glob("docs/**/*.md")), ROOT / "README.md"], ids=lambda p: p.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_one_licence() -> None:
    assert (
        "Apache License" in (ROOT / "LICENSE").read_text()
        and 'license = "Apache-2.0"' in (ROOT / "pyproject.toml").read_text()
    )


def test_every_option_stands_on_the_commands_page() -> None:
    from typer.main import get_command

    from polcap.cli import app

    page = (ROOT / "docs" / "reference" / "commands.md").read_text(encoding="utf-8")
    commands = get_command(app).commands  # type: ignore[attr-defined]
    missing = [
        f"{name} {option}"
        for name, command in commands.items()
        for parameter in command.params
        for option in parameter.opts
        if option.startswith("--") and option != "--help" and option not in page
    ]
    assert missing == [] and all(f"polcap {name}" in page for name in commands)
