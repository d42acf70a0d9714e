"""`python -m polcap` is the `polcap` command."""

from polcap.cli import main

main()
