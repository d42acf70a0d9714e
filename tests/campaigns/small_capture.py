"""A capture of 320 × 240 px in one exposure, which `polcap process` ends in under three seconds of an idle core."""

from pathlib import Path

from polcap.synth import scenes, shooting


def write(folder: Path, seed: int = 0) -> None:
    """Make it there."""
    shoot = shooting.Shoot(seed=seed, width=320, height=240, samples=1, exposures=1)
    shooting.write(folder, scenes.random_scene(seed, "bumps"), shoot)
