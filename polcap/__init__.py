"""polcap: photographs through a turned polarizer in, a relightable 3-D asset out."""

__version__ = "0.1.0"
